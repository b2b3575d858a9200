"use strict";
(() => {
  const { figures, palette } = JSON.parse(document.getElementById("data").textContent);
  const tip = document.getElementById("tip");
  const W = 380, H = 250, M = { left: 50, right: 10, top: 24, bottom: 38 };
  const DASHES = ["", "7 3", "2 2.5", "7 3 2 3"];

  function node(name, attributes, parent, text) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    parent?.append(element);
    return element;
  }
  const short = value => value === null ? "no answer" : String(Number(value.toPrecision(3)));
  const colour = style => style.is_bound ? "var(--ink)" : palette.colours[style.index % palette.colours.length];
  const OUTLINES = {
    s: "M-3.2-3.2h6.4v6.4h-6.4z", o: "M-3.5 0a3.5 3.5 0 1 0 7 0a3.5 3.5 0 1 0-7 0z", "^": "M0-4L3.8 3h-7.6z",
    D: "M0-4.2L4.2 0L0 4.2L-4.2 0z", v: "M0 4L3.8-3h-7.6z", P: "M-1.3-4h2.6v2.7h2.7v2.6h-2.7v2.7h-2.6v-2.7h-2.7v-2.6h2.7z",
    X: "M-3.5-3.5L3.5 3.5M3.5-3.5L-3.5 3.5",
  };
  const outline = style => OUTLINES[palette.markers[style.index % palette.markers.length]];

  function scale(low, high, from, to, log) {
    const f = log ? Math.log10 : x => x;
    const span = f(high) - f(low) || 1;
    return value => from + (f(value) - f(low)) / span * (to - from);
  }
  function decades(low, high) {
    const ticks = [];
    const fine = Math.log10(high / low) < 2.2;
    for (let k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k++)
      for (const m of fine ? [1, 2, 5] : [1]) if (m * 10 ** k >= low * 0.999 && m * 10 ** k <= high * 1.001) ticks.push(m * 10 ** k);
    return ticks;
  }
  function spread(values, x) {
    const kept = [];
    for (const value of values) if (!kept.length || x(value) - x(kept.at(-1)) > 34) kept.push(value);
    return kept;
  }
  function rangeOf(panels) {
    const values = panels.flatMap(p => [...p.series.flatMap(s => [...s.middle, ...s.low, ...s.high]), ...(p.y_line ? [p.y_line[0]] : [])]).filter(v => v > 0);
    return values.length ? [Math.min(...values) / 1.25, Math.max(...values) * 1.25] : [0.1, 10];
  }

  function draw(panel, range, place) {
    const svg = node("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": `${panel.title}, ${panel.y_label}` }, place);
    const xs = [...new Set(panel.series.flatMap(s => s.x))].sort((a, b) => a - b);
    const x = scale(xs[0], xs.at(-1), M.left + 8, W - M.right - 8, panel.x_is_log);
    const y = scale(range[0], range[1], H - M.bottom, M.top, true);
    for (const tick of decades(...range)) {
      node("line", { class: "grid", x1: M.left, x2: W - M.right, y1: y(tick), y2: y(tick) }, svg);
      node("text", { x: M.left - 6, y: y(tick) + 4, "text-anchor": "end" }, svg, short(tick));
    }
    for (const tick of spread(xs, x)) node("text", { x: x(tick), y: H - M.bottom + 15, "text-anchor": "middle" }, svg, short(tick));
    node("path", { class: "frame", d: `M${M.left} ${M.top}V${H - M.bottom}H${W - M.right}` }, svg);
    node("text", { class: "title", x: M.left, y: 14 }, svg, panel.title);
    node("text", { x: (M.left + W) / 2, y: H - 6, "text-anchor": "middle" }, svg, panel.x_label);
    node("text", { x: 11, y: (H - M.bottom + M.top) / 2, "text-anchor": "middle", transform: `rotate(-90 11 ${(H - M.bottom + M.top) / 2})` }, svg, panel.y_label);
    if (panel.y_line) {
      node("line", { class: "level", x1: M.left, x2: W - M.right, y1: y(panel.y_line[0]), y2: y(panel.y_line[0]) }, svg);
    }
    for (const series of panel.series) curve(svg, series, x, y);
    if (panel.y_line) {
      const level = y(panel.y_line[0]), below = level + 18 < H - M.bottom;  // errors lie above what they approach
      node("text", { x: W - M.right, y: level + (below ? 13 : -4), "text-anchor": "end", class: "name" }, svg, panel.y_line[1]);
    }
    const cross = node("line", { class: "cross", y1: M.top, y2: H - M.bottom }, svg);
    svg.addEventListener("pointermove", event => point(event, svg, panel, xs, x, cross));
    svg.addEventListener("pointerleave", () => { tip.hidden = true; cross.style.visibility = "hidden"; });
  }

  function curve(svg, series, x, y) {
    const group = node("g", { "data-name": series.name }, svg);
    const at = series.x.map((value, i) => i).filter(i => series.middle[i] !== null);
    const line = at.map((i, k) => `${k ? "L" : "M"}${x(series.x[i])} ${y(series.middle[i])}`).join("");
    if (series.style.is_bound) {
      node("path", { class: "bound", d: line, "stroke-dasharray": DASHES[series.style.index % DASHES.length] }, group);
      return;
    }
    const ranged = at.filter(i => series.low[i] > 0 && series.high[i] !== null);
    if (series.style.has_line && ranged.length > 1) {
      const edge = ranged.map(i => `${x(series.x[i])} ${y(series.high[i])}`).concat(ranged.slice().reverse().map(i => `${x(series.x[i])} ${y(series.low[i])}`));
      node("path", { class: "band", d: `M${edge.join("L")}Z`, fill: colour(series.style) }, group);
    }
    if (series.style.has_line) node("path", { class: "curve", d: line, stroke: colour(series.style) }, group);
    for (const i of at) node("path", {
      d: outline(series.style), transform: `translate(${x(series.x[i])} ${y(series.middle[i])})`,
      fill: series.style.has_line ? colour(series.style) : "var(--paper)", stroke: colour(series.style),
    }, group);
  }

  function point(event, svg, panel, xs, x, cross) {
    const box = svg.getBoundingClientRect();
    const u = (event.clientX - box.left) * W / box.width;
    const nearest = xs.reduce((best, value) => Math.abs(x(value) - u) < Math.abs(x(best) - u) ? value : best);
    cross.setAttribute("x1", x(nearest)); cross.setAttribute("x2", x(nearest)); cross.style.visibility = "visible";
    tip.replaceChildren();
    const head = document.createElement("p");
    const strong = document.createElement("b");
    strong.textContent = `${panel.x_label} ${short(nearest)}`;
    head.append(strong);
    tip.append(head);
    for (const series of panel.series) {
      if (hidden.has(series.name)) continue;
      series.x.forEach((value, i) => {
        if (value !== nearest) return;
        const line = document.createElement("p"), dot = document.createElement("i"), name = document.createElement("b");
        dot.style.background = colour(series.style);
        name.textContent = `${series.name}: ${short(series.middle[i])}`;
        const range = series.style.is_bound ? "" : ` (quartiles ${short(series.low[i])} to ${short(series.high[i])})`;
        line.append(dot, name, `${range}; ${series.notes[i]}`);
        tip.append(line);
      });
    }
    tip.hidden = false;
    const size = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, event.clientX + 18 + size.width > innerWidth ? event.clientX - size.width - 18 : event.clientX + 18)}px`;
    tip.style.top = `${Math.max(8, Math.min(event.clientY + 14, innerHeight - size.height - 8))}px`;
  }

  const hidden = new Set();
  function legend(figure, place, panels) {
    const seen = new Map(figure.rows.flat().flatMap(p => p.series).map(s => [s.name, s.style]));
    for (const [name, style] of seen) {
      const button = document.createElement("button");
      button.type = "button";
      button.setAttribute("aria-pressed", "true");
      const key = node("svg", { viewBox: "-13 -6 26 12", "aria-hidden": "true" });
      if (style.has_line || style.is_bound) node("path", { d: "M-13 0H13", stroke: colour(style), "stroke-width": 1.8, "stroke-dasharray": style.is_bound ? DASHES[style.index % DASHES.length] : "" }, key);
      if (!style.is_bound) node("path", { d: outline(style), fill: style.has_line ? colour(style) : "var(--paper)", stroke: colour(style) }, key);
      button.append(key, name);
      button.addEventListener("click", () => {
        hidden.has(name) ? hidden.delete(name) : hidden.add(name);
        button.setAttribute("aria-pressed", String(!hidden.has(name)));
        for (const group of panels.querySelectorAll("g[data-name]")) if (group.dataset.name === name) group.style.display = hidden.has(name) ? "none" : "";
      });
      place.append(button);
    }
  }

  figures.forEach((figure, k) => {
    const place = document.getElementById(`panels-${k}`);
    const columns = Math.max(...figure.rows.map(row => row.length));  // a single column is laid out side by side
    place.style.gridTemplateColumns = `repeat(${columns > 1 ? columns : "auto-fit"}, minmax(${columns > 1 ? 15 : 18}rem, 1fr))`;
    for (const row of figure.rows) for (const panel of row) draw(panel, rangeOf(row), place);
    legend(figure, document.getElementById(`legend-${k}`), place);
  });
})();
