// Turns the scene: projects points in base (mm) onto the drawing, without perspective, as drawing/scene.py did first.
(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const svg = document.getElementById("scene-view"), slider = document.getElementById("scene-motion");
  const where = document.getElementById("scene-where"), [width, height] = data.view.size;
  const first = { yaw: data.view.yaw, pitch: data.view.pitch, scale: data.view.scale, centre: [...data.view.centre] };
  const fingers = new Map();
  let view = { ...first, centre: [...first.centre] }, motion = 0, apart = 0;

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const at = (values) => values[Math.min(motion, values.length - 1)];

  function axes() {
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    return { right: [-sy, cy, 0], up: [-sp * cy, -sp * sy, cp], towards: [cp * cy, cp * sy, sp] };
  }

  function make(name, attributes, text) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text) element.textContent = text;
    return element;
  }

  function draw() {
    const { right, up, towards } = axes();
    const away = (point) => point.map((value, k) => value - view.centre[k]);
    const flat = (point) => {
      const p = away(point);
      return [width / 2 + view.scale * dot(p, right), height / 2 - view.scale * dot(p, up)];
    };
    const written = (points) => points.map((p) => `${p[0].toFixed(1)},${p[1].toFixed(1)}`).join(" ");
    const depth = (point) => dot(away(point), towards);
    const shapes = [];
    for (const line of data.lines) {
      const points = at(line.points), attributes = { class: `l-${line.style}`, points: written(points.map(flat)) };
      if (line.radius) attributes.style = `stroke-width:${(2 * line.radius * view.scale).toFixed(1)}px`;
      const mean = points.reduce((sum, point) => sum + depth(point), 0) / points.length;
      shapes.push([mean, make("polyline", attributes)]);
    }
    for (const item of data.dots) {
      const d = item.points.map(flat).map((p) => `M${p[0].toFixed(1)} ${p[1].toFixed(1)}h0`).join("");
      const mean = item.points.reduce((sum, point) => sum + depth(point), 0) / item.points.length;
      shapes.push([mean, make("path", { class: `p-${item.style}`, d })]);
    }
    for (const item of data.ellipsoids) {
      const centre = at(item.centre), outline = ellipse(at(item.covariance), right, up, item.sigmas * view.scale);
      const middle = flat(centre), points = outline.map((p) => [middle[0] + p[0], middle[1] + p[1]]);
      shapes.push([depth(centre), make("polygon", { class: `o-${item.style}`, points: written(points) })]);
    }
    for (const disc of data.discs) {
      const point = at(disc.at), [x, y] = flat(point), group = make("g", { class: `disc d-${disc.style}` });
      group.append(make("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: 5 }));
      group.append(make("text", { x: (x + 9).toFixed(1), y: (y + (disc.name === "base" ? 20 : -7)).toFixed(1) }, disc.name));
      shapes.push([depth(point) + 1e-3, group]);
    }
    shapes.sort((a, b) => a[0] - b[0]);
    svg.replaceChildren(...shapes.map((shape) => shape[1]));
  }

  // Outline of an ellipsoid seen along a direction: that of its covariance in the plane of the drawing.
  function ellipse(covariance, right, up, factor) {
    const times = (v) => covariance.map((row) => dot(row, v));
    const down = up.map((value) => -value), xx = dot(right, times(right));
    const xy = dot(right, times(down)), yy = dot(down, times(down)), points = [];
    // Cholesky factor of the 2 x 2 covariance: any square root has the same outline.
    const a = Math.sqrt(Math.max(xx, 1e-12)), b = xy / a, c = Math.sqrt(Math.max(yy - b * b, 0));
    for (let k = 0; k < 48; k += 1) {
      const angle = 2 * Math.PI * k / 48, u = Math.cos(angle), v = Math.sin(angle);
      points.push([factor * a * u, factor * (b * u + c * v)]);
    }
    return points;
  }

  function turn(yaw, pitch) {
    view.yaw += yaw;
    view.pitch = Math.min(Math.max(view.pitch + pitch, -Math.PI / 2), Math.PI / 2);
    draw();
  }

  function zoom(factor) {
    view.scale = Math.min(Math.max(view.scale * factor, first.scale / 20), first.scale * 50);
    draw();
  }

  function shift(dx, dy) {
    const { right, up } = axes();
    view.centre = view.centre.map((value, k) => value - (dx * right[k] - dy * up[k]) / view.scale);
    draw();
  }

  function reset() {
    view = { ...first, centre: [...first.centre] };
    draw();
  }

  const keys = {
    ArrowLeft: () => turn(0.1, 0), ArrowRight: () => turn(-0.1, 0), ArrowUp: () => turn(0, 0.1),
    ArrowDown: () => turn(0, -0.1), "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8), "0": reset,
  };
  svg.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  svg.addEventListener("pointerdown", (event) => {
    svg.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    apart = 0;
  });
  svg.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
    const dx = now[0] - before[0], dy = now[1] - before[1], unit = width / svg.clientWidth;
    fingers.set(event.pointerId, now);
    if (fingers.size > 1) {
      const [a, b] = [...fingers.values()], gap = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (apart) zoom(gap / apart);
      apart = gap;
      shift(dx * unit / fingers.size, dy * unit / fingers.size);
    } else if (event.shiftKey || event.buttons === 2 || event.buttons === 4) {
      shift(dx * unit, dy * unit);
    } else {
      turn(-dx * 0.008, dy * 0.008);
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    svg.addEventListener(name, (event) => { fingers.delete(event.pointerId); apart = 0; });
  }
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && document.activeElement !== svg) return;  // the page scrolls until the drawing is chosen
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 400));
  }, { passive: false });
  slider.addEventListener("input", () => {
    motion = Number(slider.value);
    where.textContent = `frame ${data.frames[motion]}, ${data.times_s[motion]} s`;
    draw();
  });
  const bar = document.querySelector(".scene-bar");
  bar.hidden = false;
  bar.addEventListener("click", (event) => {
    const name = event.target.dataset.scene;
    if (name) ({ in: () => zoom(1.25), out: () => zoom(0.8), reset })[name]();
  });
  draw();
})();
