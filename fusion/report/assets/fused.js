// The page of a result: the answer, the maps laid together under each rival, the merged map, and why.

function swatch(k) {
  return svg("svg", { class: `swatch ${ownClass(k)}`, viewBox: "0 0 26 12", "aria-hidden": "true" },
    svg("path", { class: `line link ${ownClass(k)}`, d: "M1 6H25" }), svg("path", { class: "sign", d: "M9 2h8v8h-8z" }));
}

// What a pointed-at landmark says of itself; in the merged map with what every robot had.
function describeRecorded(data, m, k) {
  const scene = data.maps[m].scene, C = scene.covariances[k];
  const rows = [["map", data.maps[m].name], ["kind", scene.kinds[k]],
    ["at", `${reads(scene.at[2 * k] + scene.origin[0])}, ${reads(scene.at[2 * k + 1] + scene.origin[1])} m`]];
  if (C) rows.push(["σ of x, y", `${reads(Math.sqrt(C[0]), 3)}, ${reads(Math.sqrt(C[2]), 3)} m`]);
  if (scene.existence?.[k] !== null && scene.existence) rows.push(["existence", reads(scene.existence[k], 3)]);
  rows.push(["detected", `${scene.counters[k][1]} of ${counted(scene.counters[k][0], "visit")}`]);
  return [scene.ids[k], rows];
}
function describeMerged(data, g, k) {
  const scene = data.groups[g].scene, C = scene.covariances[k];
  const rows = [["kind", scene.kinds[k]],
    ["at", `${reads(scene.at[2 * k] + scene.origin[0])}, ${reads(scene.at[2 * k + 1] + scene.origin[1])} m`]];
  if (C) {
    const sigma = [Math.sqrt(C[0]), Math.sqrt(C[2])];
    rows.push(["σ of x, y", `${reads(sigma[0], 3)}, ${reads(sigma[1], 3)} m`],
      ["correlation", reads(sigma[0] * sigma[1] > 0 ? C[1] / (sigma[0] * sigma[1]) : 0)]);
  }
  rows.push(["existence", reads(scene.existence[k], 3)]);
  for (const [m, , id] of scene.sources[k]) rows.push([data.maps[m].name, id]);
  rows.push(["detected", `${scene.counters[k][1]} of ${counted(scene.counters[k][0], "visit")}`]);
  return [scene.ids[k], rows];
}

class FusedPage {
  constructor(data) {
    this.data = data;
    this.off = new Set(); // maps switched off
    this.owned = []; // [owners, element, key] of everything that belongs to maps
    this.embedded = data.maps.every((map) => map.scene);
    this.pair = Math.max(0, data.pairs.findIndex((pair) => pair.decision === "ambiguous"));
    if (data.pairs.some((pair) => pair.decision === "merged")) this.pair = data.pairs.findIndex((pair) => pair.decision === "merged");
    this.merged = range(data.groups.length).filter((g) => data.groups[g].maps.length > 1);
    this.group = this.merged[0] ?? 0;
    data.maps.forEach((map, m) => range(map.scene ? map.scene.ids.length : 0).forEach((k) =>
      marks.describe.set(`${m}:${k}`, () => describeRecorded(data, m, k))));
    data.groups.forEach((group, g) => group.scene.ids.forEach((_, k) => {
      marks.describe.set(`g${g}:${k}`, () => describeMerged(data, g, k));
      for (const [m, place] of group.scene.sources[k]) if (place !== null) marks.tie(`g${g}:${k}`, `${m}:${place}`);
    }));
  }

  draw(main) {
    const { data } = this;
    this.view = new View("The maps laid together");
    this.scenes = el("div", { id: "main" }, this.view.host);
    this.side = el("div", { class: "side", id: "evidence" });
    this.uncertain = el("div", { class: "columns", id: "uncertain" });
    main.append(this.#choices(), el("div", { class: "stage" }, this.scenes, this.side), this.#layers(), this.#legend());
    if (data.pairs.length > 1) main.append(this.#pairsAndGroups());
    main.append(this.#before(), section("How well is it known?", null, this.uncertain), this.#tables());
    this.choosePair(this.pair, this.merged.length ? "merged" : null);
  }

  // Controls -----------------------------------------------------------------------------------------------------
  #choices() {
    const { data } = this;
    this.slider = el("input", { type: "range", id: "rival", min: 0, step: 1, "aria-label": "Rival placements",
      on: { input: () => this.chooseRival(Number(this.slider.value)) } });
    this.said = el("output", { id: "rival-said", for: "rival" });
    this.shares = el("div", { class: "shares", role: "group", "aria-label": "Probabilities of all placements" });
    const modes = [["merged", "Merged map"], ["placed", "Maps laid together"]];
    this.modes = new Map(modes.map(([mode]) => [mode, el("input", { type: "radio", name: "mode", value: mode, id: `mode-${mode}`, on: { change: () => this.chooseMode(mode) } })]));
    const which = data.pairs.length > 1 ? el("label", {}, "Pair ", this.pairs = el("select", { id: "pair", on: { change: () => this.choosePair(Number(this.pairs.value)) } },
      data.pairs.map((pair, k) => el("option", { value: k }, `${pair.maps.map((m) => data.maps[m].name).join(" + ")}: ${pair.decision.replace("_", " ")}`)))) : null;
    const group = this.merged.length > 1 ? el("label", {}, "Group ", this.groupChoice = el("select", { id: "group", on: { change: () => { this.group = Number(this.groupChoice.value); this.chooseMode("merged"); } } },
      this.merged.map((g) => el("option", { value: g }, `${data.groups[g].maps.map((m) => data.maps[m].name).join(" + ")}`)))) : null;
    const toggles = data.maps.map((map, m) => checkbox(named(map.name), true, (shown) => this.#toggle(m, shown), swatch(m)));
    toggles.forEach((label, m) => { label.querySelector("input").dataset.map = m; });
    return el("div", { class: "controls" },
      el("fieldset", { class: "rivals" }, el("legend", {}, "How can the maps lie to each other?"), which, this.shares, el("div", { class: "slide" }, this.slider), this.said),
      el("fieldset", {}, el("legend", {}, "Show"), modes.map(([mode, label]) => el("label", { class: "check" }, this.modes.get(mode), label)), group),
      el("fieldset", {}, el("legend", {}, "Maps"), toggles));
  }
  #layers() {
    return el("div", { class: "controls" }, el("fieldset", {}, el("legend", {}, "Also"), ellipseChoice(),
      layerChoices([["ellipses", "ellipses"], ["links", "links"], ["walls", "walls"], ["paths", "paths"], ["matches", "matches"]])));
  }
  #legend() {
    const scenes = [...this.data.maps.map((map) => map.scene), ...this.data.groups.map((group) => group.scene)].filter(Boolean);
    return el("p", { class: "legends" }, legendOf(scenes), el("span", { class: "legend" }, swatch(-1), "seen by several robots (ringed)"),
      el("span", { class: "legend" }, svg("svg", { class: "own own0 doubtful", viewBox: "-7 -7 14 14" }, svg("path", { class: "sign", d: SIGNS.corner })), "hollow: rather not there"));
  }
  #toggle(m, shown) {
    this.off[shown ? "delete" : "add"](m);
    for (const entry of this.owned) this.#apply(entry);
  }
  #apply([owners, element]) {
    element.classList.toggle("off", owners.length > 0 && owners.every((m) => this.off.has(m)));
  }
  #own(owners, element) {
    const entry = [owners, element];
    this.owned.push(entry);
    this.#apply(entry);
  }
  #ownScene(drawn, ownersOf) {
    for (const [who, elements] of drawn.own) for (const element of elements) this.#own(who >= 0 ? [who] : ownersOf(element), element);
  }

  // Pictures -----------------------------------------------------------------------------------------------------
  chooseMode(mode) {
    this.mode = mode;
    this.modes.get(mode).checked = true;
    this.modes.get("merged").disabled = !this.merged.length;
    this.modes.get("placed").disabled = !this.embedded || !this.data.pairs.length;
    this.#clear();
    this.view.world.replaceChildren();
    if (mode === "merged" && this.merged.length) this.#drawMerged();
    else this.#drawPlaced();
  }
  #clear() {
    this.owned = this.owned.filter(([, element]) => !this.view.svg.contains(element));
    for (const [key, set] of marks.elements) for (const element of set) if (this.view.svg.contains(element)) marks.drop(element, key);
    forget();
  }
  #drawMerged() {
    const g = this.group, { scene } = this.data.groups[g];
    if (this.groupChoice) this.groupChoice.value = g;
    const drawn = drawScene(scene, (k) => `g${g}:${k}`);
    const ownersOf = (element) => {
      const key = element.dataset?.key;
      const k = key ? Number(key.split(":")[1]) : null;
      return k === null ? this.data.groups[g].maps : [...new Set(scene.sources[k].map(([m]) => m))];
    };
    this.#ownScene(drawn, ownersOf);
    this.view.world.append(drawn.group);
    this.view.keys = range(scene.ids.length).map((k) => `g${g}:${k}`);
    this.view.fit(boundsOf([{ scene }]));
    this.modeSaid = "merged";
  }
  #drawPlaced() {
    const pair = this.data.pairs[this.pair];
    if (!pair || !this.embedded) {
      this.view.world.append(svg("text", { class: "empty" }, "The recorded maps aren't in this result."));
      return;
    }
    const [one, two] = pair.maps.map((m) => this.data.maps[m].scene);
    const drawn = [one, two].map((scene, side) => {
      const d = drawScene(scene, (k) => `${pair.maps[side]}:${k}`);
      this.#ownScene(d, () => [pair.maps[side]]);
      return d.group;
    });
    this.moving = svg("g", { class: "moving", id: "map2" }, drawn[1]);
    this.matches = svg("g", { class: "matches" });
    this.view.world.append(drawn[0], this.moving, this.matches);
    this.view.keys = pair.maps.flatMap((m, side) => range([one, two][side].ids.length).map((k) => `${m}:${k}`));
    this.#lay();
    this.view.fit(this.laid);
  }
  // Lays map 2 where the chosen rival has it; beside map 1 where they share nothing.
  #lay() {
    const pair = this.data.pairs[this.pair], rival = pair.rivals[this.rival];
    const [one, two] = pair.maps.map((m) => this.data.maps[m].scene);
    const [a, b] = [boundsOf([{ scene: one }]), boundsOf([{ scene: two }])];
    this.pose = rival?.pose ?? [a.high[0] - b.low[0] + 0.15 * (a.high[0] - a.low[0]) + 3, (a.low[1] + a.high[1] - b.low[1] - b.high[1]) / 2, 0];
    const [x, y, turn] = this.pose;
    this.moving.style.transform = `translate(${x}px, ${-y}px) rotate(${-turn}rad)`;
    this.moving.style.setProperty("--back", `${turn}rad`);
    this.moving.dataset.pose = this.pose.join(" ");
    this.laid = boundsOf([{ scene: one }, { scene: two, pose: this.pose }]);
    this.matches.replaceChildren();
    for (const [i, j] of rival?.matches ?? []) {
      const [px, py] = [one.at[2 * i], one.at[2 * i + 1]], [qx, qy] = moved(this.pose, two.at[2 * j], two.at[2 * j + 1]);
      this.matches.append(svg("path", { class: "match", d: `M${px} ${-py}L${qx} ${-qy}` }),
        svg("circle", { class: "matchring", r: 9, style: { "--x": `${px}px`, "--y": `${-py}px` } }));
    }
  }

  // Pairs and rivals ---------------------------------------------------------------------------------------------
  choosePair(k, mode = "placed") {
    this.pair = k;
    const pair = this.data.pairs[k];
    if (this.pairs) this.pairs.value = k;
    if (!pair) {
      this.slider.disabled = true;
      this.chooseMode(this.merged.length ? "merged" : "placed");
      return;
    }
    this.slider.max = pair.rivals.length;
    this.slider.disabled = !pair.rivals.length;
    const share = (p, n, label, title) => el("button", { type: "button", class: `share share${n}`, "data-rival": n === "none" ? pair.rivals.length : n, style: { "flex-grow": p, "flex-basis": 0 }, title,
      "aria-label": title, on: { click: () => this.chooseRival(n === "none" ? pair.rivals.length : n) } }, p > 0.06 ? label : "");
    // hypotheses too improbable to be seen are reached by the slider alone
    refill(this.shares, pair.rivals.map((r, n) => (r.probability < 0.002 && n ? null : share(r.probability, n, `${n + 1}: ${r.likelihood}`, `Placement ${n + 1}: ${r.likelihood}`))),
      share(pair.none, "none", `no overlap: ${pair.none_text}`, `No overlap: ${pair.none_text}`));
    this.rival = pair.decision === "no_overlap" || !pair.rivals.length ? pair.rivals.length : 0;
    this.slider.value = this.rival;
    this.chooseMode(mode ?? (this.merged.length ? "merged" : "placed"));
    this.#tell();
  }
  chooseRival(n) {
    this.rival = n;
    this.slider.value = n;
    if (this.mode !== "placed" && this.embedded) this.chooseMode("placed");
    else if (this.embedded) {
      this.#lay();
      this.view.include(this.laid);
    }
    this.#tell();
  }
  #tell() {
    const pair = this.data.pairs[this.pair], rival = pair.rivals[this.rival];
    const more = pair.left_out ? `; ${pair.left_out} more are not shown, together ${pair.left_out_text}` : "";
    const text = rival ? `Placement ${this.rival + 1} of ${pair.rivals.length}: probability ${rival.likelihood}, ${rival.count} matching. ${rival.text}`
      : `No overlap: probability ${pair.none_text}${more}`;
    const decided = { merged: this.rival === 0, no_overlap: this.rival === pair.rivals.length, ambiguous: false }[pair.decision];
    this.said.replaceChildren(el("strong", {}, decided ? "This is the answer. " : pair.decision === "ambiguous" ? "Possible, not decided. " : "Not the answer. "), text);
    this.slider.setAttribute("aria-valuetext", text);
    for (const button of this.shares.children) button.setAttribute("aria-pressed", Number(button.dataset.rival) === this.rival);
    this.#evidence(pair, rival);
    this.#uncertainty(pair, rival);
  }
  #evidence(pair, rival) {
    const [m1, m2] = pair.maps, names = pair.maps.map((m) => this.data.maps[m].name);
    const matched = () => (rival?.matches ?? []).flatMap(([i, j]) => [`${m1}:${i}`, `${m2}:${j}`]);
    const missed = () => (rival?.missed ?? [[], []]).flatMap((ids, side) => ids.map((k) => `${pair.maps[side]}:${k}`));
    const keys = { matches: matched, missed, both: () => [...matched(), ...missed()], none: () => [] };
    const most = Math.max(1, ...(rival?.evidence ?? []).map((row) => Math.abs(row.nats)));
    const row = (e) => lighting(el("button", { type: "button", class: `term ${e.nats > 0 ? "for" : "against"}`, "data-term": e.name, "data-marks": e.marks },
      el("span", { class: "label" }, e.label), el("span", { class: "nats" }, `${e.nats > 0 ? "+" : "−"}${reads(Math.abs(e.nats), 1)}`),
      el("span", { class: "track" }, el("span", { class: "fill", style: { width: `${(50 * Math.abs(e.nats)) / most}%` } })),
      e.why ? el("span", { class: "why" }, e.why) : null), keys[e.marks] ?? keys.none);
    const list = (title, wanted) => {
      const rows = (rival?.evidence ?? []).filter((e) => wanted === (e.nats > 0));
      return rows.length ? [el("h3", {}, title), ...rows.map(row)] : [];
    };
    const sum = rival ? el("p", { class: "sum" }, `Together ${rival.nats > 0 ? "+" : "−"}${reads(Math.abs(rival.nats), 1)} nats: ` +
      `that is ${odds(rival.nats)} against the maps showing different places, before the rivals are weighed.`) : null;
    refill(this.side, el("h2", {}, "Why?"), el("p", { class: "pairname" }, named(names[0]), " and ", named(names[1])),
      el("p", { class: "reason" }, named(pair.reason)),
      pair.overruled ? el("p", {}, "Overruled by the cycle of ", pair.overruled.flatMap((m, k) => [k ? ", " : "", named(this.data.maps[m].name)])) : null,
      ...list("Speaks for it", true), ...list("Speaks against it", false), sum,
      rival && !rival.evidence.length ? el("p", { class: "note" }, "What the evidence of this placement consists of isn't in the file.") : null,
      rival ? el("p", { class: "note" }, "Point at a line, or tab to it, to light up the landmarks that it speaks of. Numbers are nats: +2.3 makes ten times as probable.") : null);
  }
  #uncertainty(pair, rival) {
    const parts = [];
    if (rival) {
      const [m1, m2] = pair.maps;
      const name = (m, k) => this.data.maps[m].scene.ids[k];
      parts.push(el("div", {}, el("h3", {}, "Where map 2 lies in map 1"), el("p", {}, rival.text), el("div", { class: "wide" }, poseTable(rival, this.rival === 0 ? pair.mixture : null)),
        el("p", { class: "note" }, "Standard deviations, and how strongly the errors go together (−1 to 1).")));
      if (this.embedded) parts.push(el("div", { id: "residuals" }, el("h3", {}, "What is left between matched landmarks"), target(rival,
        (k) => [`${m1}:${rival.matches[k][0]}`, `${m2}:${rival.matches[k][1]}`], (k) => `${name(m1, rival.matches[k][0])} = ${name(m2, rival.matches[k][1])}`),
        el("p", { class: "note" }, "As recorded: before merging bends both maps within what their robots can have been wrong by.")));
    }
    const joint = this.data.groups[this.group]?.scene.joint;
    if (joint) parts.push(el("div", {}, el("h3", {}, "Errors of landmarks hang together"),
      el("p", {}, "In ", this.data.groups[this.group].maps.flatMap((m, k) => [k ? " + " : "", named(this.data.maps[m].name)]), this.merged.length ? ", merged." : ", alone."),
      jointPicture({ ...joint, prefix: `g${this.group}` }, (k) => this.data.groups[this.group].scene.ids[k])));
    this.uncertain.replaceChildren(...parts);
  }

  // Below --------------------------------------------------------------------------------------------------------
  #before() {
    const views = this.data.maps.map((map, m) => {
      if (!map.scene) return el("p", {}, named(map.name), ": not embedded in this result");
      const build = () => {
        const view = new View(`Map ${map.name} as it was recorded`, range(map.scene.ids.length).map((k) => `${m}:${k}`));
        const drawn = drawScene(map.scene, (k) => `${m}:${k}`);
        this.#ownScene(drawn, () => [m]);
        view.world.append(drawn.group);
        view.fit(boundsOf([map]));
        return view.host;
      };
      const caption = el("figcaption", {}, swatch(m), named(map.name), `: ${counted(map.scene.ids.length, "landmark")}` +
        `${map.simulated ? ", simulated" : ""}`, map.robot ? [", by ", named(map.robot)] : null);
      return el("figure", { class: "small", "data-map": m }, caption, m < 8 ? build() : lateView(build));
    });
    return section("Before: the maps as they were recorded", "Each in its own frame, which is where its robot started. What is pointed at lights up in all pictures.",
      el("div", { class: "smalls" }, views));
  }
  #pairsAndGroups() {
    const { data } = this;
    const cells = (pair) => [pair.maps.map((m) => data.maps[m].name).join(" + "), pair.decision.replace("_", " "), pair.likelihood, pair.none_text, String(pair.count)];
    const rows = data.pairs.map((pair, k) => el("tr", { class: `decision ${pair.decision}` },
      el("td", {}, el("button", { type: "button", class: "link", on: { click: () => { this.choosePair(k); this.scenes.scrollIntoView({ block: "nearest" }); } } }, named(cells(pair)[0]))),
      cells(pair).slice(1).map((text) => el("td", {}, text)), el("td", { class: "text" }, named(pair.T12 ?? ""))));
    const groups = data.groups.map((group) => el("li", {}, group.maps.length > 1 ? "merged: " : "alone: ", group.maps.flatMap((m, k) => [k ? ", " : "", named(data.maps[m].name)])));
    return section("Pairs and groups", "Each pair of maps by itself, and what the maps around it make of it.", el("ul", { id: "groups" }, groups),
      el("div", { class: "wide" }, el("table", { id: "pairs" }, el("thead", {}, el("tr", {}, ["maps", "decision", "best placement", "no overlap", "common", "T12"].map((h) => el("th", { scope: "col" }, h)))), el("tbody", {}, rows))));
  }
  #tables() {
    const { data } = this;
    const rows = () => data.groups.flatMap((group, g) => group.scene.ids.map((id, k) => {
      const { scene } = group, C = scene.covariances[k];
      return { key: `g${g}:${k}`, cells: [id, scene.kinds[k], reads(scene.at[2 * k] + scene.origin[0]), reads(scene.at[2 * k + 1] + scene.origin[1]),
        C ? reads(Math.sqrt(Math.max(C[0], C[2])), 3) : "", reads(scene.existence[k], 3), scene.sources[k].map(([m, , i]) => `${data.maps[m].name}: ${i}`).join("; ")] };
    }));
    const total = data.groups.reduce((sum, group) => sum + group.scene.ids.length, 0);
    const frames = data.frames.length ? el("details", {}, el("summary", {}, "Frames: where each map lies in its group"), el("div", { class: "wide" }, el("table", {}, el("tbody", {},
      data.frames.map((frame) => el("tr", {}, el("th", { scope: "row" }, named(data.maps[frame.map].name)), el("td", {}, `group ${frame.group + 1}`), el("td", {}, frame.text))))))) : null;
    return section("All numbers", null, lateTable(`${counted(total, "landmark")} of the result`, ["id", "kind", "x [m]", "y [m]", "σ [m]", "existence", "recorded as"], rows, true), frames);
  }
}

const lateView = (build) => {
  const button = el("button", { type: "button", on: { click: () => button.replaceWith(build()) } }, "Draw");
  return button;
};
// Nats as odds for people.
function odds(nats) {
  const power = Math.abs(nats) / Math.LN10;
  const text = power < 4 ? String(Math.round(10 ** power)) : `10^${Math.round(power)}`;
  return nats >= 0 ? `${text} to 1` : `1 to ${text}`;
}
