// The page of a comparison: tables that are sorted by a click on a head and filtered by a word, then pictures.
function comparePage(data, main) {
  main.append(...data.sheets.map(sheetOf), ...data.pictures.map(({ title, src }) =>
    section(title, null, el("img", { src, alt: title, class: "picture" }))));
}

function sheetOf({ title, note, heads, rows }) {
  const state = { sort: -1, down: false, word: "" };
  const body = el("tbody"), where = el("output");
  const value = (cell) => { const found = /^-?\d+(\.\d+)?/.exec(cell.replace(/^[<>] /, "")); return found ? Number(found[0]) : null; };
  const order = (a, b) => {
    const [x, y] = [value(a), value(b)];
    return x !== null && y !== null ? x - y : x !== null ? -1 : y !== null ? 1 : a.localeCompare(b);
  };
  const show = () => {
    const word = state.word.toLowerCase();
    const seen = rows.filter((row) => !word || row.some((cell) => cell.toLowerCase().includes(word)));
    if (state.sort >= 0) seen.sort((a, b) => (state.down ? -1 : 1) * order(a[state.sort], b[state.sort]));
    body.replaceChildren(...seen.map((row) => el("tr", {}, row.map((cell) => el("td", {}, named(cell))))));
    where.textContent = `${seen.length} of ${counted(rows.length, "row")}`;
  };
  const sorter = (head, k) => el("th", { scope: "col" }, el("button", { type: "button", class: "link", on: { click: () => {
    state.down = state.sort === k ? !state.down : false; state.sort = k; show(); } } }, head));
  const table = el("table", {}, el("thead", {}, el("tr", {}, heads.map(sorter))), body);
  const word = el("input", { type: "search", "aria-label": `Filter ${title}`, placeholder: "a word", on: { input: () => { state.word = word.value; show(); } } });
  show();
  const controls = rows.length > 8 ? el("div", { class: "controls" }, word, where) : null;
  return section(title, note || null, controls, el("div", { class: "wide" }, table));
}
