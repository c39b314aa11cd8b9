// A picture that can be moved and zoomed by mouse, touch and keyboard. The world is in metres, y upwards; signs keep
// their size on the screen: --u is how many metres a pixel is.
const SIGNS = {
  corner: "M-4.4-4.4h8.8v8.8h-8.8z",
  "T-junction": "M0-5.4L5.4 4H-5.4z",
  crossing: "M-1.8-5.2h3.6v3.4h3.4v3.6h-3.4v3.4h-3.6v-3.4h-3.4v-3.6h3.4z",
  "end of corridor": "M0-5.2L5-1.6 3.1 4.3H-3.1L-5-1.6z",
  door: "M0-5.6L5.6 0 0 5.6-5.6 0z",
  corridor: "M0-5.8L3.4 0 0 5.8-3.4 0z",
  point: "M-4.4 0a4.4 4.4 0 1 0 8.8 0a4.4 4.4 0 1 0-8.8 0z",
};
const HOW_TO_MOVE = "Arrow keys move, plus and minus zoom, 0 shows all, N and B go to the next and previous landmark.";
const OTHER_SIGN = "M-2.7-4.7h5.4L5.4 0 2.7 4.7h-5.4L-5.4 0z";
const ownClass = (owner) => (owner < 0 ? "common" : `own own${owner % 6}`);

const pairs = (flat) => range(flat.length / 2).map((k) => [flat[2 * k], flat[2 * k + 1]]);
const polyline = (flat) => pairs(flat).map(([x, y], k) => `${k ? "L" : "M"}${x} ${-y}`).join("");

function boundsOf(scenes) {
  const box = { low: [Infinity, Infinity], high: [-Infinity, -Infinity] };
  const take = (x, y) => {
    box.low = [Math.min(box.low[0], x), Math.min(box.low[1], y)];
    box.high = [Math.max(box.high[0], x), Math.max(box.high[1], y)];
  };
  for (const { scene, pose } of scenes) {
    for (const flat of [scene.at, ...scene.walls, scene.path ?? []])
      for (const [x, y] of pairs(flat)) take(...moved(pose ?? [0, 0, 0], x, y));
  }
  if (box.low[0] === Infinity) return { low: [-2, -2], high: [2, 2] };
  return box;
}
function moved([tx, ty, turn], x, y) {
  const c = Math.cos(turn), s = Math.sin(turn);
  return [tx + c * x - s * y, ty + s * x + c * y];
}

class View {
  constructor(label, keys = []) {
    this.keys = keys; // landmarks in the order in which the keyboard visits them
    this.at = new Map(); // key -> function giving its place in the world
    this.current = -1;
    this.world = svg("g", { class: "world" });
    this.svg = svg("svg", { class: "view", tabindex: 0, role: "application", "aria-label": `${label}. ${HOW_TO_MOVE}` }, this.world);
    const button = (text, title, act) => el("button", { type: "button", title, "aria-label": title, on: { click: act } }, text);
    this.scaleBar = el("span", { class: "scale" });
    this.host = el("div", { class: "viewhost" }, this.svg, el("div", { class: "zoom" },
      button("+", "Zoom in", () => this.zoom(1.4)), button("−", "Zoom out", () => this.zoom(1 / 1.4)),
      button("⤢", "Show all", () => this.fit())), this.scaleBar);
    this.scale = 1; this.centre = [0, 0];
    this.#listen();
    new ResizeObserver(() => this.#resized()).observe(this.svg);
  }
  // Shows everything between two corners [m].
  fit(bounds = this.bounds) {
    this.bounds = bounds;
    const { width, height } = this.svg.getBoundingClientRect();
    if (!width || !height) return;
    const across = Math.max(bounds.high[0] - bounds.low[0], 4), up = Math.max(bounds.high[1] - bounds.low[1], 4);
    this.scale = Math.max(Math.min((width - 44) / across, (height - 44) / up), 1e-6);
    this.whole = this.scale;
    this.centre = [(bounds.low[0] + bounds.high[0]) / 2, (bounds.low[1] + bounds.high[1]) / 2];
    this.#place();
  }
  // Shows everything again where part of it lies outside of the picture.
  include(bounds) {
    this.bounds = bounds;
    const { width, height } = this.svg.getBoundingClientRect();
    const out = [bounds.low, bounds.high].some((corner) => [width, height].some((size, k) => Math.abs(corner[k] - this.centre[k]) * this.scale > size / 2));
    if (out) this.fit();
  }
  zoom(factor, at = null) {
    const next = Math.min(Math.max(this.scale * factor, this.whole / 20), this.whole * 400);
    if (at) {
      const rect = this.svg.getBoundingClientRect();
      const off = [at[0] - rect.left - rect.width / 2, -(at[1] - rect.top - rect.height / 2)];
      this.centre = [0, 1].map((k) => this.centre[k] + off[k] * (1 / this.scale - 1 / next));
    }
    this.scale = next;
    this.#place();
  }
  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.#place();
  }
  #place() {
    const { width, height } = this.svg.getBoundingClientRect();
    const [x, y] = [width / 2 - this.centre[0] * this.scale, height / 2 + this.centre[1] * this.scale];
    this.world.style.transform = `translate(${x}px, ${y}px) scale(${this.scale})`;
    this.world.style.setProperty("--u", String(1 / this.scale));
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];
    const length = steps.find((step) => step * this.scale > 50) ?? 10000;
    this.scaleBar.style.width = `${length * this.scale}px`;
    this.scaleBar.textContent = `${length} m`;
  }
  #resized() {
    if (!this.bounds) return;
    const { width } = this.svg.getBoundingClientRect();
    if (!this.seen || Math.abs(width - this.seen) > 1) this.fit();
    this.seen = width;
  }
  #listen() {
    const down = new Map();
    let spread = 0;
    const apart = () => { const [a, b] = [...down.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    this.svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), [event.clientX, event.clientY]);
    }, { passive: false });
    this.svg.addEventListener("pointerdown", (event) => {
      down.set(event.pointerId, [event.clientX, event.clientY]);
      if (down.size === 2) spread = apart();
    });
    this.svg.addEventListener("pointermove", (event) => {
      const last = down.get(event.pointerId);
      if (last) {
        if (!event.buttons && event.pointerType === "mouse") { down.delete(event.pointerId); return; }
        if (down.size === 1) this.pan(event.clientX - last[0], event.clientY - last[1]);
        down.set(event.pointerId, [event.clientX, event.clientY]);
        if (down.size === 2) {
          const now = apart(), [a, b] = [...down.values()];
          if (spread > 0) this.zoom(now / spread, [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
          spread = now;
        }
      }
      const key = event.target.closest?.("[data-key]")?.dataset.key;
      if (key) showMark(key, event.clientX, event.clientY);
      else if (!last) forget();
    });
    for (const name of ["pointerup", "pointercancel"]) this.svg.addEventListener(name, (event) => down.delete(event.pointerId));
    this.svg.addEventListener("pointerleave", (event) => { down.delete(event.pointerId); forget(); });
    this.svg.addEventListener("click", (event) => {
      const key = event.target.closest?.("[data-key]")?.dataset.key;
      if (key) showMark(key, event.clientX, event.clientY);
    });
    this.svg.addEventListener("blur", forget);
    this.svg.addEventListener("keydown", (event) => {
      const acts = {
        ArrowLeft: () => this.pan(60, 0), ArrowRight: () => this.pan(-60, 0), ArrowUp: () => this.pan(0, 60),
        ArrowDown: () => this.pan(0, -60), "+": () => this.zoom(1.3), "=": () => this.zoom(1.3),
        "-": () => this.zoom(1 / 1.3), 0: () => this.fit(), n: () => this.visit(1), b: () => this.visit(-1),
        Escape: () => forget(),
      };
      const act = acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act();
    });
  }
  // Goes to the next landmark that is switched on, and tells what it is.
  visit(step) {
    const seen = this.keys.filter((key) => [...(marks.elements.get(key) ?? [])].some((e) => this.svg.contains(e) && !e.classList.contains("off")));
    if (!seen.length) return;
    this.current = (this.current + step + seen.length) % seen.length;
    const key = seen[this.current];
    const element = [...marks.elements.get(key)].find((e) => this.svg.contains(e) && e.matches(".mark"));
    let box = element.getBoundingClientRect(), host = this.svg.getBoundingClientRect();
    const off = [box.left + box.width / 2 - host.left, box.top + box.height / 2 - host.top];
    if (off[0] < 20 || off[1] < 20 || off[0] > host.width - 20 || off[1] > host.height - 20) {
      this.pan(host.width / 2 - off[0], host.height / 2 - off[1]);
      box = element.getBoundingClientRect();
    }
    showMark(key, box.left + box.width / 2, box.top + box.height / 2);
  }
}

// One scene as a group: walls, path, ellipses, links and signs from below. keyOf(k) names its landmarks.
function drawScene(scene, keyOf) {
  const group = svg("g", { class: "scene" });
  const own = new Map();
  const belongs = (owner, element) => {
    if (!own.has(owner)) own.set(owner, []);
    own.get(owner).push(element);
    return element;
  };
  const owner = scene.owners[0] ?? 0;
  const line = (cls, d, who) => d ? [belongs(who, svg("path", { class: `line ${cls} ${ownClass(who)}`, d }))] : [];
  const single = scene.owners.every((o) => o === owner) ? owner : null;
  group.append(svg("g", { class: "walls" }, line("wall", scene.walls.map(polyline).join(""), single ?? -2)));
  if (scene.path) group.append(svg("g", { class: "paths" }, line("path", polyline(scene.path), single ?? -2)));
  const at = pairs(scene.at);
  const ellipses = svg("g", { class: "ellipses" }), links = svg("g", { class: "links" }), signs = svg("g", { class: "signs" });
  const doubtful = new Set(scene.doubtful);
  const ways = new Map();
  for (let k = 0; k < scene.links.length; k += 3) {
    const [a, b, who] = scene.links.slice(k, k + 3);
    ways.set(who, `${ways.get(who) ?? ""}M${at[a][0]} ${-at[a][1]}L${at[b][0]} ${-at[b][1]}`);
  }
  for (const [who, d] of ways) links.append(...line("link", d, who));
  at.forEach(([x, y], k) => {
    const key = keyOf(k), who = scene.owners[k], C = scene.covariances[k];
    if (C) {
      const mean = (C[0] + C[2]) / 2, half = Math.hypot((C[0] - C[2]) / 2, C[1]);
      const turn = Math.atan2(2 * C[1], C[0] - C[2]) / 2;
      const ellipse = svg("ellipse", {
        class: `ellipse ${ownClass(who)}`, rx: Math.sqrt(mean + half), ry: Math.sqrt(Math.max(mean - half, 0)),
        style: { transform: `translate(${x}px, ${-y}px) rotate(${-turn}rad) scale(var(--k))` },
      });
      marks.add(key, ellipse);
      ellipses.append(belongs(who, ellipse));
    }
    const arms = scene.arms[k], d = [];
    for (let n = 0; n < arms.length; n += 2) {
      const [c, s] = [Math.cos(arms[n]), -Math.sin(arms[n])];
      if (arms[n + 1]) d.push(`M${5 * c} ${5 * s}L${9.5 * c} ${9.5 * s}`);
      else d.push(`M${7 * c - 3.5 * s} ${7 * s + 3.5 * c}L${7 * c + 3.5 * s} ${7 * s - 3.5 * c}`);
    }
    const sign = svg("g", {
      class: `mark ${ownClass(who)}${doubtful.has(k) ? " doubtful" : ""}`, "data-key": key,
      style: { "--x": `${x}px`, "--y": `${-y}px` },
    }, svg("circle", { class: "reach", r: 9 }), d.length ? svg("path", { class: "arms", d: d.join("") }) : null,
      who < 0 ? svg("circle", { class: "ring", r: 8.5 }) : null,
      svg("path", { class: "sign", d: SIGNS[scene.kinds[k]] ?? OTHER_SIGN }));
    marks.add(key, sign);
    signs.append(belongs(who, sign));
  });
  group.append(ellipses, links, signs);
  return { group, own };
}

// The confidence of all ellipses of the page, and what else may be hidden.
function ellipseChoice() {
  const levels = [[0.5, "50 %"], [0.6827, "68 %"], [0.9, "90 %"], [0.95, "95 %"], [0.99, "99 %"], [0.999, "99.9 %"]];
  const choose = (p) => root.style.setProperty("--k", String(Math.sqrt(-2 * Math.log(1 - p))));
  const select = el("select", { id: "confidence", on: { change: () => choose(Number(select.value)) } },
    levels.map(([p, text]) => el("option", { value: p, selected: p === 0.95 }, text)));
  choose(0.95);
  return el("label", {}, "Ellipses hold the true place with ", select);
}
function layerChoices(layers) {
  return layers.map(([name, label, on = true]) => {
    root.classList.toggle(`no-${name}`, !on);
    return checkbox(label, on, (shown) => root.classList.toggle(`no-${name}`, !shown));
  });
}
function legendOf(scenes) {
  const kinds = [...new Set(scenes.flatMap((scene) => scene.kinds))].sort();
  return kinds.map((kind) => el("span", { class: "legend" },
    svg("svg", { viewBox: "-7 -7 14 14", "aria-hidden": "true" }, svg("path", { d: SIGNS[kind] ?? OTHER_SIGN })), kind));
}
