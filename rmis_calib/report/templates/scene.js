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
      const point = at(disc.at), [x, y] = flat(point);
      const attributes = { class: `d-${disc.style}`, cx: x.toFixed(1), cy: y.toFixed(1), r: 5 };
      shapes.push([depth(point) + 1e-3, make("circle", attributes)]);
    }
    shapes.sort((a, b) => a[0] - b[0]);
    const labels = data.discs.map((disc) => ({ name: disc.name, side: disc.side, point: flat(at(disc.at)) }));
    svg.replaceChildren(...shapes.map((shape) => shape[1]), ...placed(labels).map((label) => make("text", {
      x: label.point[0].toFixed(1), y: label.point[1].toFixed(1), dx: `${label.dx.toFixed(2)}em`,
      dy: `${label.dy.toFixed(2)}em`, "text-anchor": label.dx > 0 ? "start" : "end",
    }, label.name)));
  }

  // The labels of the points inside the drawing, each at its nearest free place, as drawing/labels.py placed them.
  function placed(labels) {
    const { text_sizes: sizes, letter, wide_letter: wide, ascent, descent, line } = data.labels;
    const { beside, above, below, disc, rows } = data.labels;
    const inside = labels.filter(({ point: [x, y] }) => x >= 0 && x <= width && y >= 0 && y <= height);
    const done = [];
    const box = ({ name, point: [x, y] }, { side, dy }, size) => {
      const ends = [side * beside, side * (beside + letter * name.length + wide)].sort((a, b) => a - b);
      return [x + size * ends[0], y + size * (dy - ascent), x + size * ends[1], y + size * (dy + descent)];
    };
    const around = ({ point: [x, y] }, r) => [x - r, y - r, x + r, y + r];
    const overlap = (a, b) => Math.max(Math.min(a[2], b[2]) - Math.max(a[0], b[0]), 0)
      * Math.max(Math.min(a[3], b[3]) - Math.max(a[1], b[1]), 0);
    const covered = (label, place) => sizes.reduce((total, size) => {
      const mine = box(label, place, size);
      const taken = done.map((other) => box(other, other.place, size));
      for (const other of labels) if (other !== label) taken.push(around(other, disc * size));
      const outside = overlap(mine, mine) - overlap(mine, [0, 0, width, height]);
      return total + (outside + taken.reduce((sum, other) => sum + overlap(mine, other), 0)) / size ** 2;
    }, 0);
    for (const label of inside.sort((a, b) => b.point[0] - a.point[0])) {
      let least = Infinity;
      for (let row = 0; row < rows; row += 1) {
        for (const dy of [above - line * row, below + line * row]) {
          for (const side of [label.side, -label.side]) {
            const cost = covered(label, { side, dy });
            if (cost < least) [least, label.place] = [cost, { side, dy }];
          }
        }
      }
      done.push(label);
    }
    return labels.filter((label) => label.place).map((label) => ({ ...label, dx: label.place.side * beside, dy: label.place.dy }));
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
