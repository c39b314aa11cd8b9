// The page of a batch run: what was merged, each group drawn when it is opened, and all pairs, some hundred at a time.
const PAGE = 200;
// A group's line names so many of its maps; all of them are named where it is opened.
const NAMED = 12;
const DECISIONS = ["merged", "ambiguous", "no overlap", "failed"];

function batchPage(data, main) {
  main.append(groupsOfBatch(data), pairsOfBatch(data));
}

function groupsOfBatch(data) {
  const shown = data.groups.map((group, g) => {
    const listed = (maps) => maps.flatMap((m, k) => [k ? ", " : "", named(data.maps[m].name)]);
    const more = group.maps.length - NAMED;
    const names = more > 1 ? [...listed(group.maps.slice(0, NAMED)), ` and ${more} more`] : listed(group.maps);
    const draw = () => {
      if (!details.open || details.querySelector(".viewhost")) return;
      group.scene = JSON.parse(document.getElementById(`group-${g}`).textContent);
      group.scene.ids.forEach((_, k) => marks.describe.set(`g${g}:${k}`, () => describeMerged(data, g, k)));
      const view = new View(`Group ${g + 1}`, range(group.scene.ids.length).map((k) => `g${g}:${k}`));
      view.world.append(drawScene(group.scene, (k) => `g${g}:${k}`).group);
      details.append(view.host);
      view.fit(boundsOf([group]));
    };
    const details = el("details", { class: "group", "data-group": g, on: { toggle: draw } },
      el("summary", {}, `${counted(group.maps.length, "map")}, ${counted(group.count, "landmark")}, ${group.sure} right: `, names),
      more > 1 ? el("p", { class: "note" }, "All of them: ", listed(group.maps)) : null,
      el("p", { class: "note" }, "In full: ", el("code", {}, named(`mapfuse show ${group.file} --html`))));
    return details;
  });
  const alone = data.alone.length ? el("details", {}, el("summary", {}, `${counted(data.alone.length, "map")} merged with none`),
    el("p", {}, data.alone.flatMap((m, k) => [k ? ", " : "", named(data.maps[m].name)]))) : null;
  return section("Groups", "Maps that share a frame. Open one to see it: black and ringed is what several robots saw, coloured what one did, hollow what rather isn't there.", el("div", { class: "controls" }, ellipseChoice(), layerChoices([["ellipses", "ellipses"], ["links", "links"], ["walls", "walls"]])),
    el("div", { id: "groups" }, shown), alone);
}

function pairsOfBatch(data) {
  const { rows } = data.pairs; // each: map 1, map 2, decision, probability, no overlap or null, common, T12, error
  const state = { page: 0, sort: 3, down: true, decision: "all", name: "" };
  const heads = ["map 1", "map 2", "decision", "probability of the best placement", "common", "T12 or what went wrong"];
  const columns = [0, 1, 2, 3, 4, 5];
  const body = el("tbody"), where = el("output", { id: "where" });
  const text = (row) => [data.maps[row[0]].name, data.maps[row[1]].name, DECISIONS[row[2]], row[3], row[4], row[5]];
  let seen = [];
  const choose = () => {
    const name = state.name.toLowerCase(), wanted = DECISIONS.indexOf(state.decision);
    seen = rows.filter((row) => (wanted < 0 || row[2] === wanted) &&
      (!name || [row[0], row[1]].some((m) => data.maps[m].name.toLowerCase().includes(name))));
    const value = (row) => (state.sort < 2 ? data.maps[row[state.sort]].name : row[state.sort]);
    const sign = state.down ? -1 : 1;
    seen.sort((a, b) => { const [x, y] = [value(a), value(b)]; return x === y ? 0 : x === null ? 1 : y === null ? -1 : sign * (x < y ? -1 : 1); });
    state.page = 0;
    show();
  };
  const show = () => {
    const part = seen.slice(state.page * PAGE, (state.page + 1) * PAGE);
    body.replaceChildren(...part.map((row) => el("tr", { class: `decision ${DECISIONS[row[2]].replace(" ", "_")}` },
      text(row).map((cell, k) => el("td", {}, k < 2 || k === 5 ? named(String(cell ?? "")) : k === 3 ? (cell === null ? "" : data.percent(cell)) : String(cell ?? ""))))));
    const first = seen.length ? state.page * PAGE + 1 : 0;
    where.textContent = `${first} to ${Math.min(seen.length, (state.page + 1) * PAGE)} of ${seen.length} pairs`;
    back.disabled = state.page === 0;
    on.disabled = (state.page + 1) * PAGE >= seen.length;
  };
  data.percent = (p) => (p > 0.9999 ? "> 99.99 %" : p < 0.0001 ? "< 0.01 %" : `${Number((100 * p).toPrecision(4))} %`);
  const turn = (step) => { state.page += step; show(); };
  const back = el("button", { type: "button", on: { click: () => turn(-1) } }, "Back");
  const on = el("button", { type: "button", id: "on", on: { click: () => turn(1) } }, "Next");
  const sorter = (k) => el("th", { scope: "col" }, el("button", { type: "button", class: "link", on: { click: () => {
    state.down = state.sort === columns[k] ? !state.down : true; state.sort = columns[k]; choose(); } } }, heads[k]));
  const table = el("table", { id: "pairs" }, el("thead", {}, el("tr", {}, heads.map((_, k) => sorter(k)))), body);
  const decision = el("select", { id: "decision", on: { change: () => { state.decision = decision.value; choose(); } } },
    el("option", { value: "all" }, "all decisions"), DECISIONS.map((d) => el("option", { value: d }, d)));
  const name = el("input", { type: "search", id: "name", "aria-label": "Map's name", placeholder: "a map's name", on: { input: () => { state.name = name.value; choose(); } } });
  choose();
  return section("Pairs", null, el("div", { class: "controls" }, decision, name, back, on, where), el("div", { class: "wide" }, table));
}
