// Pictures enlarged in a dialog: wheel, pinch, drag and keys move the viewBox of a copy.
(() => {
  "use strict";
  const dialog = document.getElementById("zoom");
  const view = dialog.querySelector(".zoom-view"), words = dialog.querySelector(".zoom-words");
  const pictures = [...document.querySelectorAll("button.enlarge")];
  const fingers = new Map();
  let number = 0, svg = null, whole = null, box = null, apart = 0;

  function show(next) {
    number = (next + pictures.length) % pictures.length;
    svg = pictures[number].querySelector("svg").cloneNode(true);
    whole = svg.getAttribute("viewBox").split(" ").map(Number);
    box = [...whole];
    view.replaceChildren(svg);
    words.textContent = `${number + 1} of ${pictures.length}. ${svg.getAttribute("aria-label")}`;
  }

  function apply() {
    const [x, y, width, height] = whole;
    box[2] = Math.min(Math.max(box[2], width / 40), width);
    box[3] = box[2] * height / width;
    box[0] = Math.min(Math.max(box[0], x), x + width - box[2]);
    box[1] = Math.min(Math.max(box[1], y), y + height - box[3]);
    svg.setAttribute("viewBox", box.map((value) => value.toFixed(2)).join(" "));
  }

  function place(x, y) {
    const point = new DOMPoint(x, y).matrixTransform(svg.getScreenCTM().inverse());
    return [point.x, point.y];
  }

  function zoom(factor, at) {
    const [x, y] = at || [box[0] + box[2] / 2, box[1] + box[3] / 2];
    box = [x - (x - box[0]) / factor, y - (y - box[1]) / factor, box[2] / factor, box[3] / factor];
    apply();
  }

  function move(dx, dy) {
    box[0] += dx;
    box[1] += dy;
    apply();
  }

  const buttons = {
    previous: () => show(number - 1),
    next: () => show(number + 1),
    in: () => zoom(1.5),
    out: () => zoom(1 / 1.5),
    lines: (button) => {
      const hidden = view.classList.toggle("no-lines");
      button.setAttribute("aria-pressed", String(!hidden));
    },
    close: () => dialog.close(),
  };
  const keys = {
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), "0": () => zoom(1e-6),
    n: () => show(number + 1), p: () => show(number - 1),
    ArrowLeft: () => move(-box[2] / 10, 0), ArrowRight: () => move(box[2] / 10, 0),
    ArrowUp: () => move(0, -box[3] / 10), ArrowDown: () => move(0, box[3] / 10),
  };

  pictures.forEach((button, index) => button.addEventListener("click", () => {
    show(index);
    dialog.showModal();
    view.focus();
  }));
  dialog.addEventListener("click", (event) => {
    const button = event.target.closest("[data-zoom]");
    if (button) buttons[button.dataset.zoom](button);
  });
  view.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  view.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 400), place(event.clientX, event.clientY));
  }, { passive: false });
  view.addEventListener("pointerdown", (event) => {
    view.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    apart = 0;
  });
  view.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
    fingers.set(event.pointerId, now);
    if (fingers.size === 1) {
      const a = place(...before), b = place(...now);
      move(a[0] - b[0], a[1] - b[1]);
    } else {
      const [a, b] = [...fingers.values()], gap = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (apart) zoom(gap / apart, place((a[0] + b[0]) / 2, (a[1] + b[1]) / 2));
      apart = gap;
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    view.addEventListener(name, (event) => { fingers.delete(event.pointerId); apart = 0; });
  }
})();
