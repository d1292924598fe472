"use strict";
(() => {
  const data = JSON.parse(document.getElementById("player-data").textContent);
  const player = document.getElementById("player");
  const SVG = "http://www.w3.org/2000/svg";
  // Lightness falls all the way: it is read without seeing colours.
  const RAMP = [[255, 255, 204], [254, 217, 118], [253, 141, 60], [227, 26, 28], [128, 0, 38]];
  const STAGE_MS = 600, LINE = 10;
  const make = (tag, attributes = {}, parent = null, text = "") => {
    const svg = parent instanceof SVGElement || tag === "svg";
    const node = svg ? document.createElementNS(SVG, tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.textContent = text;
    if (parent) parent.append(node);
    return node;
  };
  const colour = share => {
    const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
    const first = Math.min(Math.floor(place), RAMP.length - 2), rest = place - first;
    return `rgb(${RAMP[first].map((c, i) => Math.round(c + rest * (RAMP[first + 1][i] - c))).join(",")})`;
  };

  // ---- what a state looks like: each view has `show(frame)` ----------------------------------------------------------

  const network = (parent, label, levelsOf, layout) => {
    const { places, edges, names, levels } = layout;
    const xs = places.map(p => p[0]), ys = places.map(p => p[1]);
    const lengths = edges.map(([a, b]) => Math.hypot(xs[a] - xs[b], ys[a] - ys[b])).sort((a, b) => a - b);
    const unit = lengths.length ? lengths[lengths.length >> 1] : 1;
    // A long line goes on in the next row, as text does; left stays left.
    const first = Math.min(...xs), isLine = ys.every(y => y === ys[0]) && (Math.max(...xs) - first) / unit > 12;
    const row = x => isLine ? Math.floor((x - first) / unit / LINE + 1e-6) : 0;
    const at = places.map(([x, y]) => [x / unit - LINE * row(x), y / unit + 1.5 * row(x)]);
    const [left, right] = [Math.min(...at.map(p => p[0])) - 0.7, Math.max(...at.map(p => p[0])) + 0.7];
    const [top, bottom] = [Math.min(...at.map(p => p[1])) - 0.8, Math.max(...at.map(p => p[1])) + 0.7];
    const box = make("div", { class: right - left > 14 ? "long crowded" : right - left > 8 ? "long" : "" }, parent);
    make("div", { class: "soft" }, box, label);
    const svg = make("svg", { class: "net", role: "img", "aria-label": label,
      viewBox: `${left} ${top} ${right - left} ${bottom - top}` }, box);
    for (const [a, b] of edges) {
      const kind = row(xs[a]) === row(xs[b]) ? "" : "wrap";
      make("line", { class: kind, x1: at[a][0], y1: at[a][1], x2: at[b][0], y2: at[b][1] }, svg);
    }
    const nodes = at.map(([x, y], i) => {
      const circle = make("circle", { class: "place", cx: x, cy: y, r: 0.3 }, svg);
      const title = make("title", {}, circle);
      const short = names[i].length <= 3;
      const text = make("text", { class: "name", x, y: short ? y + 0.1 : y + 0.55, "font-size": short ? 0.28 : 0.2,
        "text-anchor": "middle" }, svg, names[i]);
      return { circle, title, text, short };
    });
    const robots = make("g", {}, svg);
    return frame => {
      box.hidden = levelsOf(frame) === null;
      if (box.hidden) return;
      levelsOf(frame).forEach((level, i) => {
        const share = levels ? level / levels : 0;
        nodes[i].circle.setAttribute("fill", colour(share));
        nodes[i].title.textContent = `location ${names[i]}: damage ${level}`;
        if (nodes[i].short) nodes[i].text.style.fill = share > 0.6 ? "#fff" : "#1b1f24";
      });
      robots.replaceChildren();
      frame.robots.forEach((here, robot) => {
        const together = frame.robots.filter(other => other === here).length;
        const rank = frame.robots.slice(0, robot).filter(other => other === here).length;
        const angle = -Math.PI / 4 + 2 * Math.PI * rank / together;
        const x = at[here][0] + 0.38 * Math.cos(angle), y = at[here][1] + 0.38 * Math.sin(angle);
        const group = make("g", { class: "robot" }, robots);
        const to = frame.to ? frame.to[robot] : null;
        if (to !== null && to >= 0) {
          const far = Math.hypot(at[to][0] - x, at[to][1] - y);
          const [dx, dy] = [(at[to][0] - x) / far, (at[to][1] - y) / far];
          const [ex, ey] = [at[to][0] - 0.34 * dx, at[to][1] - 0.34 * dy];
          make("path", { d: `M${x} ${y}L${ex} ${ey}M${ex - 0.18 * dx + 0.12 * dy} ${ey - 0.18 * dy - 0.12 * dx}L${ex} ${ey}` +
            `L${ex - 0.18 * dx - 0.12 * dy} ${ey - 0.18 * dy + 0.12 * dx}` }, group);
        } else if (to !== null) {
          const [px, py] = [x + 0.3 * Math.cos(angle), y + 0.3 * Math.sin(angle)];
          make("path", { d: `M${px - 0.11} ${py}h0.22M${px} ${py - 0.11}v0.22` }, group);
        }
        make("circle", { cx: x, cy: y, r: 0.16 }, group);
        make("text", { x, y: y + 0.08, "font-size": 0.22, "text-anchor": "middle" }, group, String(robot + 1));
      });
    };
  };

  const bars = (parent, label) => {
    const box = make("div", {}, parent);
    make("div", { class: "soft" }, box, label);
    const list = make("div", { class: "bars" }, box);
    // Rows: name, share of the track in [0, 1], text, whether it is chosen.
    return rows => {
      box.hidden = rows.length === 0;
      list.replaceChildren();
      for (const [name, share, text, chosen] of rows) {
        make("span", chosen ? { class: "chosen" } : {}, list, chosen ? `▸ ${name}` : name);
        const track = make("span", { class: "track" }, list);
        const fill = make("span", chosen ? { class: "chosen" } : {}, track);
        fill.style.width = `${100 * Math.min(Math.max(share, 0), 1)}%`;
        make("span", chosen ? { class: "chosen" } : {}, list, text);
      }
    };
  };

  const state = parent => {
    const layout = data.scene;
    if (layout.kind === "network") {
      const nets = make("div", { class: "nets" }, parent);
      const known = network(nets, "what is known: expected damage", frame => frame.damage, layout);
      const truth = network(nets, "the truth", frame => frame.truth, layout);
      return frame => { known(frame); truth(frame); };
    }
    const belief = bars(parent, "what is known");
    const text = make("div", { class: "text" }, parent), truth = make("div", { class: "text truth" }, parent);
    return frame => {
      belief(frame.bars.map((value, i) => [layout.bars[i], value, value.toFixed(3), false]));
      text.textContent = frame.text;
      truth.textContent = frame.truth ? `the truth: ${frame.truth}` : "";
    };
  };

  const factors = rows => {
    const values = rows.map(row => row[1]), least = Math.min(...values), most = Math.max(...values);
    return rows.map(([name, q, chosen]) => [name, most > least ? (q - least) / (most - least) : 0,
      q === least ? "least" : `+${(q - least).toPrecision(3) * 1}`, chosen]);
  };

  const sides = document.getElementById("sides");
  const views = data.policies.map(name => {
    const box = make("section", { class: "side", "aria-label": name }, sides);
    make("h3", {}, box, name);
    const cost = make("div", { class: "cost" }, box), does = make("div", { class: "does" }, box);
    const shown = state(box), q = bars(box, "Q-factors of the base policy, above the least; the best controls");
    return frame => {
      cost.textContent = `cost so far ${frame.cost.toFixed(Math.abs(frame.cost) < 100 ? 2 : 0)}`;
      does.textContent = frame.does;
      shown(frame);
      q(factors(frame.q));
    };
  });

  // ---- what is shown now -----------------------------------------------------------------------------------------------

  const slider = document.getElementById("stage"), button = document.getElementById("play");
  const start = document.getElementById("start"), output = document.getElementById("stage-text");
  let timer = null;
  const last = () => Math.max(...data.starts[start.value].map(frames => frames.length)) - 1;
  const show = stage => {
    slider.max = last();
    slider.value = Math.min(Math.max(stage, 0), last());
    output.textContent = `stage ${slider.value} of ${slider.max}`;
    data.starts[start.value].forEach((frames, i) => views[i](frames[Math.min(slider.value, frames.length - 1)]));
  };
  const stop = () => {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  };
  const step = () => {
    show(+slider.value + 1);
    if (+slider.value === last()) stop();
  };
  button.addEventListener("click", () => {
    if (timer !== null) return stop();
    if (+slider.value === last()) show(0);
    timer = setInterval(step, STAGE_MS);
    button.textContent = "Pause";
  });
  slider.addEventListener("input", () => { stop(); show(+slider.value); });
  start.addEventListener("change", () => { stop(); show(0); });
  const jumps = { ArrowLeft: stage => stage - 1, ArrowRight: stage => stage + 1, Home: () => 0, End: () => last() };
  document.addEventListener("keydown", event => {
    const own = event.target === slider || event.target === start;
    if (own || event.altKey || event.ctrlKey || event.metaKey || !(event.key in jumps)) return;
    event.preventDefault();
    stop();
    show(jumps[event.key](+slider.value));
  });
  data.starts.forEach((_, i) => make("option", { value: i }, start, `start state ${i + 1}`));
  player.hidden = false;
  show(0);
})();
