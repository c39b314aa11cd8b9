// Pages of one map, and of one log: a picture, what is pointed at, and all numbers.

function singlePage(data, main) {
  const map = data.maps[0], scene = map?.scene ?? null, view = new View(data.answer.word);
  const scenes = [];
  if (data.ground) {
    const ground = svg("g", { class: "ground" });
    for (const part of data.ground) {
      const d = part.dots ? pairs(part.at).map(([x, y]) => `M${x} ${-y}h0`).join("") : part.lines.map(polyline).join("");
      ground.append(svg("path", { class: `line ${part.looks}`, d }));
      scenes.push({ scene: { at: part.beyond ? [] : part.dots ? part.at : part.lines.flat(), walls: [] } });
    }
    view.world.append(ground);
  }
  if (scene) {
    scene.ids.forEach((_, k) => marks.describe.set(`0:${k}`, () => describeRecorded(data, 0, k)));
    view.world.append(drawScene(scene, (k) => `0:${k}`).group);
    view.keys = range(scene.ids.length).map((k) => `0:${k}`);
    scenes.push({ scene });
  }
  const layers = [["ellipses", "ellipses"], ["links", "links"], ["walls", "walls"], ["paths", "path"]];
  const shown = scene ? [ellipseChoice(), layerChoices(layers)] : [];
  const parts = (data.ground ?? []).map((part) => checkbox(part.label, true, (on) => root.classList.toggle(`no-${part.looks}`, !on),
    svg("svg", { class: "swatch", viewBox: "0 0 26 12" }, svg("path", { class: `line ${part.looks}`, d: part.dots ? "M7 6h0M13 6h0M19 6h0" : "M1 6H25" }))));
  main.append(el("div", { class: "controls" }, el("fieldset", {}, el("legend", {}, "Show"), shown, parts)), el("div", { id: "main" }, view.host),
    el("p", { class: "legends" }, scene ? legendOf([scene]) : []));
  view.fit(boundsOf(scenes));
  if (!scene) return;
  const rows = () => scene.ids.map((id, k) => ({ key: `0:${k}`, cells: [id, scene.kinds[k], reads(scene.at[2 * k] + scene.origin[0]), reads(scene.at[2 * k + 1] + scene.origin[1]),
    scene.covariances[k] ? reads(Math.sqrt(Math.max(scene.covariances[k][0], scene.covariances[k][2])), 3) : "", scene.existence[k] === null ? "" : reads(scene.existence[k], 3)] }));
  main.append(section("All numbers", null, lateTable(counted(scene.ids.length, "landmark"), ["id", "kind", "x [m]", "y [m]", "σ [m]", "existence"], rows, true)));
  if (scene.joint) main.append(section("Errors of landmarks hang together", null, jointPicture({ ...scene.joint, prefix: "0" }, (k) => scene.ids[k])));
}
