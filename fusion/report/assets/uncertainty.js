// What isn't exactly known, as pictures: correlations, how landmarks hang together, and what is left at matches.

// Dark to light, told apart by lightness alone (points of matplotlib's viridis).
const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
function shade(value) {
  const at = Math.min(Math.max(value, 0), 1) * (STOPS.length - 1), k = Math.min(Math.floor(at), STOPS.length - 2);
  return STOPS[k].map((c, n) => Math.round(c + (at - k) * (STOPS[k + 1][n] - c)));
}

function shadeBar(low, high) {
  const canvas = el("canvas", { width: 101, height: 1, class: "bar", "aria-hidden": "true" });
  const context = canvas.getContext("2d");
  for (const k of range(101)) {
    context.fillStyle = `rgb(${shade(k / 100).join()})`;
    context.fillRect(k, 0, 1, 1);
  }
  return el("span", { class: "shadebar" }, low, canvas, high);
}

// The joint covariance as a picture: how closely the errors of each two landmarks go together.
function jointPicture(joint, nameOf) {
  const { size, step, order } = joint;
  const bytes = Uint8Array.from(atob(joint.bytes), (c) => c.charCodeAt(0));
  const canvas = el("canvas", { width: size, height: size, class: "matrix", id: "joint", tabindex: 0, role: "img",
    "aria-label": `How closely the errors of each two of ${order.length} landmarks go together. Arrow keys read single cells.` });
  const context = canvas.getContext("2d");
  const image = context.createImageData(size, size);
  bytes.forEach((value, k) => image.data.set([...shade(value / 255), 255], 4 * k));
  context.putImageData(image, 0, 0);
  let cell = [0, 0];
  const who = (k) => step === 1 ? nameOf(order[k]) : `${nameOf(order[k * step])} and ${counted(Math.min(step, order.length - k * step) - 1, "neighbour")}`;
  const tell = (x, y) => {
    const box = canvas.getBoundingClientRect();
    const value = bytes[cell[1] * size + cell[0]] / 255;
    tip.show(reads(value), [["between", who(cell[0])], ["and", who(cell[1])]],
      x ?? box.left + ((cell[0] + 0.5) / size) * box.width, y ?? box.top + ((cell[1] + 0.5) / size) * box.height);
    marks.light(cell.map((k) => `${joint.prefix}:${order[k * step]}`));
  };
  canvas.addEventListener("pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    cell = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]
      .map((f) => Math.min(size - 1, Math.max(0, Math.floor(f * size))));
    tell(event.clientX, event.clientY);
  });
  canvas.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    cell = cell.map((k, n) => Math.min(size - 1, Math.max(0, k + way[n])));
    tell();
  });
  for (const event of ["pointerleave", "blur"]) canvas.addEventListener(event, forget);
  return el("figure", {}, canvas, el("figcaption", {}, shadeBar("independent ", " move as one"),
    step > 1 ? el("span", { class: "note" }, ` Each cell stands for ${step} × ${step} landmarks, by the closest two.`) : null));
}

// Correlations of a pose's x, y and theta.
function poseTable(rival, mixture) {
  const names = ["x", "y", "θ"], units = [" m", " m", "°"];
  const cell = (value, a, b) => {
    const [r, g, blue] = shade(Math.abs(value));
    return el("td", { class: "shaded", style: { background: `rgb(${r},${g},${blue})`, color: 0.3 * r + 0.6 * g + 0.1 * blue > 130 ? "#000" : "#fff" },
      title: `correlation of ${a} and ${b}` }, reads(value));
  };
  if (!rival.correlations) return el("p", {}, "The uncertainty of this placement isn't known.");
  return el("table", { class: "pose" },
    el("thead", {}, el("tr", {}, el("th", {}, ""), el("th", { scope: "col" }, "σ if right"),
      mixture ? el("th", { scope: "col" }, "σ over all of them") : null, names.map((n) => el("th", { scope: "col" }, n)))),
    el("tbody", {}, names.map((n, k) => el("tr", {}, el("th", { scope: "row" }, n),
      el("td", {}, `${rival.sigmas[k]}${units[k]}`), mixture ? el("td", {}, `${mixture[k]}${units[k]}`) : null,
      rival.correlations[k].map((value, m) => cell(value, n, names[m]))))));
}

// Where map 2's matched landmarks lie seen from those of map 1, all laid on one centre.
function target(rival, keysOf, nameOf) {
  const apart = rival.apart ?? [];
  if (!apart.length) return el("p", {}, "No matches to compare.");
  const distances = apart.map(([x, y]) => Math.hypot(x, y));
  const far = Math.max(...distances, 0.02);
  const steps = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
  const ring = steps.find((step) => step * 4 >= far) ?? far / 4;
  const R = 100, scale = R / (ring * 4.2);
  const picture = svg("svg", { class: "target", viewBox: "-112 -112 224 224", role: "img", "aria-label": "Where matched landmarks lie to each other" });
  for (const k of [1, 2, 3, 4]) {
    picture.append(svg("circle", { class: "ringline", r: k * ring * scale }),
      svg("text", { class: "ringname", x: 2, y: -k * ring * scale - 2 }, `${Number((k * ring).toPrecision(2))} m`));
  }
  picture.append(svg("path", { class: "ringline", d: "M-104 0H104M0-104V104" }));
  apart.forEach(([x, y], k) => {
    const dot = svg("circle", { class: "dot", r: 4, cx: x * scale, cy: -y * scale, tabindex: 0, role: "img",
      "aria-label": `${nameOf(k)}: ${reads(distances[k])} m apart` });
    const tell = () => { const box = dot.getBoundingClientRect(); tip.show(nameOf(k), [["apart", `${reads(distances[k])} m`], ["in x", `${reads(x)} m`], ["in y", `${reads(y)} m`]], box.right, box.bottom); };
    lighting(dot, () => keysOf(k));
    for (const event of ["pointerenter", "focus"]) dot.addEventListener(event, tell);
    picture.append(dot);
  });
  const sorted = [...distances].sort((a, b) => a - b);
  return el("figure", {}, picture, el("figcaption", {}, `${counted(apart.length, "match")}`.replace("matchs", "matches") +
    `: ${reads(sorted[Math.floor(sorted.length / 2)])} m apart (median), ${reads(far)} m (largest).`));
}
