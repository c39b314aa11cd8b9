// Elements are made of text and attributes only: nothing that comes out of a file is ever parsed as HTML.
const SVG = "http://www.w3.org/2000/svg";

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "on") for (const [event, call] of Object.entries(value)) element.addEventListener(event, call);
    else if (name === "style") for (const [key, text] of Object.entries(value)) element.style.setProperty(key, text);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  for (const child of children.flat()) if (child !== null && child !== undefined) element.append(child);
  return element;
}
function refill(element, ...children) {
  element.replaceChildren();
  return filled(element, {}, children);
}
const el = (tag, attributes = {}, ...children) => filled(document.createElement(tag), attributes, children);
const svg = (tag, attributes = {}, ...children) => filled(document.createElementNS(SVG, tag), attributes, children);
// Names may run right to left: each is isolated, so that it can't reorder the words around it.
const named = (text) => el("bdi", { class: "name" }, text);
const root = document.documentElement;
const reads = (x, digits = 2) => (x === null || x === undefined ? "unknown" : Number(x).toFixed(digits));
const counted = (n, noun) => `${n} ${noun}${n === 1 ? "" : "s"}`;
const range = (n) => Array.from({ length: n }, (_, k) => k);

// What is the same landmark in several pictures lights up in all of them.
const marks = {
  elements: new Map(), // key -> elements in all pictures
  kin: new Map(), // key -> keys of the same landmark
  describe: new Map(), // key -> function giving [label, text] rows
  add(key, element) {
    if (!this.elements.has(key)) this.elements.set(key, new Set());
    this.elements.get(key).add(element);
  },
  drop(element, key) {
    this.elements.get(key)?.delete(element);
  },
  tie(a, b) {
    for (const [from, to] of [[a, b], [b, a]]) {
      if (!this.kin.has(from)) this.kin.set(from, new Set());
      this.kin.get(from).add(to);
    }
  },
  lit: [],
  light(keys, dim = true) {
    for (const element of this.lit) element.classList.remove("hot");
    const all = new Set(keys);
    for (const key of keys) for (const other of this.kin.get(key) ?? []) all.add(other);
    this.lit = [...all].flatMap((key) => [...(this.elements.get(key) ?? [])]);
    for (const element of this.lit) element.classList.add("hot");
    root.classList.toggle("lighting", dim && this.lit.length > 0);
  },
};

// The box that tells what is pointed at; it is read aloud where a keyboard moves through landmarks.
const tip = {
  box: el("div", { class: "tip", role: "status", "aria-live": "polite", hidden: true }),
  show(title, rows, x, y) {
    this.box.replaceChildren(
      el("strong", {}, named(title)),
      el("dl", {}, rows.flatMap(([label, text]) => [el("dt", {}, named(label)), el("dd", {}, named(text))])),
    );
    this.box.hidden = false;
    const { width, height } = this.box.getBoundingClientRect();
    const left = x + 16 + width > innerWidth ? x - width - 12 : x + 16;
    this.box.style.left = `${Math.max(4, Math.min(left, innerWidth - width - 4))}px`;
    this.box.style.top = `${Math.max(4, Math.min(y + 14, innerHeight - height - 4))}px`;
  },
  hide() {
    this.box.hidden = true;
  },
};

function showMark(key, x, y) {
  const described = marks.describe.get(key)?.();
  if (!described) return;
  tip.show(described[0], described[1], x, y);
  marks.light([key], false);
}
function forget() {
  tip.hide();
  marks.light([]);
}

// Lights landmarks while something is pointed at or has the keyboard's focus.
function lighting(element, keys) {
  const on = () => marks.light(keys());
  for (const event of ["pointerenter", "focus"]) element.addEventListener(event, on);
  for (const event of ["pointerleave", "blur"]) element.addEventListener(event, forget);
  return element;
}

function section(title, note, ...children) {
  return el("section", {}, el("h2", {}, title), note ? el("p", { class: "note" }, note) : null, ...children);
}

function checkbox(label, checked, changed, swatch = null) {
  const box = el("input", { type: "checkbox", checked, on: { change: () => changed(box.checked) } });
  return el("label", { class: "check" }, box, swatch, label);
}

// A table whose rows are made when it is first opened: thousands of rows cost nothing until then.
function lateTable(title, heads, rows, lit = null) {
  const body = el("tbody");
  const fill = () => {
    if (body.childElementCount || !details.open) return;
    for (const row of rows()) {
      const line = el("tr", {}, row.cells.map((cell) => el("td", {}, typeof cell === "string" ? named(cell) : cell)));
      if (lit && row.key) {
        line.tabIndex = 0;
        lighting(line, () => [row.key]);
      }
      body.append(line);
    }
  };
  const table = el("table", {}, el("thead", {}, el("tr", {}, heads.map((h) => el("th", { scope: "col" }, h)))), body);
  const details = el("details", { on: { toggle: fill } }, el("summary", {}, title), el("div", { class: "wide" }, table));
  return details;
}

function themeButton() {
  const themes = ["auto", "light", "dark"];
  let k = 0;
  const button = el("button", { type: "button", id: "theme", on: { click: () => choose(k + 1) } });
  const choose = (next) => {
    k = next % themes.length;
    root.dataset.theme = themes[k];
    button.textContent = `Colours: ${themes[k]}`;
    document.dispatchEvent(new Event("theme"));
  };
  choose(0);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => document.dispatchEvent(new Event("theme")));
  return button;
}
