const data = JSON.parse(document.getElementById("data").textContent);
const main = document.querySelector("main");
document.body.append(tip.box);
document.querySelector("header").append(themeButton());
if (data.kind === "fused") new FusedPage(data).draw(main);
else if (data.kind === "batch") batchPage(data, main);
else if (data.kind === "compare") comparePage(data, main);
else singlePage(data, main);
root.dataset.ready = "yes";
