"use strict";
// The gallery: a toggle for each mask, the flip to the clean twin, brighter images, two filters, and the sample at
// full size.
const gallery = document.querySelector(".gallery");
const dialog = document.getElementById("sample");
const state = { clean: false, brighter: false, open: null, hidden: new Set() };

function show() {
  for (const button of document.querySelectorAll(".toggle[data-fault]"))
    button.setAttribute("aria-pressed", String(!state.hidden.has(button.dataset.fault)));
  for (const mask of document.querySelectorAll(".mask")) mask.hidden = state.hidden.has(mask.dataset.fault);
  for (const flip of document.querySelectorAll(".flip")) flip.setAttribute("aria-pressed", String(state.clean));
  for (const button of document.querySelectorAll(".brighter")) button.setAttribute("aria-pressed", String(state.brighter));
  document.body.classList.toggle("show-clean", state.clean);
  document.body.classList.toggle("show-brighter", state.brighter);
}

function toggle(fault) {
  if (!state.hidden.delete(fault)) state.hidden.add(fault);
  show();
}

function cards() {
  return [...gallery.children].filter((card) => !card.hidden);
}

function choose() {
  const split = document.getElementById("g-split").value;
  const fault = document.getElementById("g-class").value;
  for (const card of gallery.children) {
    const faults = card.dataset.faults ? card.dataset.faults.split(" ") : [];
    const has = fault === "" || (fault === "none" ? !faults.length : faults.includes(fault));
    card.hidden = !(has && (split === "" || card.dataset.split === split));
  }
  document.getElementById("g-count").textContent = `${cards().length} shown`;
}

function open(card) {
  const frame = card.querySelector(".frame").cloneNode(true);
  const image = frame.querySelector(".image");
  const holder = dialog.querySelector(".holder");
  holder.style.setProperty("--ratio", String(image.getAttribute("width") / image.getAttribute("height")));
  holder.replaceChildren(frame);
  const aside = dialog.querySelector("aside");
  aside.replaceChildren(card.querySelector("template").content.cloneNode(true));
  aside.scrollTop = 0;
  const own = [...frame.querySelectorAll(".mask")].map((mask) => mask.dataset.fault);
  const buttons = own.map((fault) => document.querySelector(`.tools .toggle[data-fault="${fault}"]`));
  dialog.querySelector(".masks").replaceChildren(...buttons.filter(Boolean).map((button) => button.cloneNode(true)));
  state.open = card;
  if (!dialog.open) dialog.showModal();
  show();
}

function step(by) {
  const list = cards();
  const next = list[list.indexOf(state.open) + by];
  if (next) open(next);
}

if (gallery) {
  for (const button of document.querySelectorAll(".tools .toggle[data-fault]"))
    if (button.getAttribute("aria-pressed") !== "true") state.hidden.add(button.dataset.fault);
  document.addEventListener("click", (event) => {
    const button = event.target.closest(".toggle[data-fault]");
    if (button) toggle(button.dataset.fault);
  });
  for (const flip of document.querySelectorAll(".flip"))
    flip.addEventListener("click", () => { state.clean = !state.clean; show(); });
  for (const button of document.querySelectorAll(".brighter"))
    button.addEventListener("click", () => { state.brighter = !state.brighter; show(); });
  for (const id of ["g-split", "g-class"]) document.getElementById(id).addEventListener("change", choose);
  gallery.addEventListener("click", (event) => {
    const button = event.target.closest(".open");
    if (button) open(button.closest(".card"));
  });
  for (const button of dialog.querySelectorAll("[data-step]"))
    button.addEventListener("click", () => step(Number(button.dataset.step)));
  dialog.querySelector("[data-close]").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => state.open?.querySelector(".open").focus());
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, input")) return;
    if (event.key === "c") { state.clean = !state.clean; show(); }
    else if (event.key === "b") { state.brighter = !state.brighter; show(); }
    else if (/^[1-9]$/.test(event.key)) {
      const button = document.querySelectorAll(".tools .toggle[data-fault]")[event.key - 1];
      if (button) toggle(button.dataset.fault);
    } else if (dialog.open && event.key === "ArrowLeft") step(-1);
    else if (dialog.open && event.key === "ArrowRight") step(1);
  });
  show();
}

// The spheres: drag them, or focus them and use the arrow keys.
for (const globe of document.querySelectorAll(".sphere")) {
  const data = JSON.parse(globe.parentElement.querySelector("script").textContent);
  let [azimuth, elevation] = data.view.map((angle) => (angle * Math.PI) / 180);
  const circle = [];
  for (let a = 0; a <= 360; a += 6) circle.push((a * Math.PI) / 180);
  const lines = [];
  for (let a = 0; a < 180; a += 30) {
    const c = Math.cos((a * Math.PI) / 180), s = Math.sin((a * Math.PI) / 180);
    lines.push(circle.map((t) => [Math.cos(t) * c, Math.cos(t) * s, Math.sin(t)]));
  }
  for (const e of [-60, -30, 0, 30, 60]) {
    const c = Math.cos((e * Math.PI) / 180), s = Math.sin((e * Math.PI) / 180);
    lines.push(circle.map((t) => [c * Math.cos(t), c * Math.sin(t), s]));
  }
  const project = ([x, y, z]) => {
    const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
    const ahead = ca * x + sa * y;
    const right = -sa * x + ca * y, up = -se * ahead + ce * z;
    return [data.size / 2 + data.radius * right, data.size / 2 - data.radius * up, ce * ahead + se * z];
  };
  const draw = () => {
    for (const side of ["far", "near"]) {
      const seen = (depth) => depth >= 0 === (side === "near");
      let path = "";
      for (const line of lines) {
        let drawing = false;
        for (const point of line) {
          const [x, y, depth] = project(point);
          if (seen(depth)) path += `${drawing ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
          drawing = seen(depth);
        }
      }
      globe.querySelector(`.graticule.${side}`).setAttribute("d", path);
      globe.querySelectorAll(`.dots.${side}`).forEach((dots, k) => {
        let marks = "";
        for (const point of data.points[k]) {
          const [x, y, depth] = project(point);
          if (seen(depth)) marks += `M${x.toFixed(1)} ${y.toFixed(1)}h0`;
        }
        dots.setAttribute("d", marks);
      });
    }
    globe.querySelectorAll(".axis-name").forEach((name, k) => {
      const [x, y, depth] = project(data.labels[k]);
      name.setAttribute("x", x);
      name.setAttribute("y", y);
      name.style.opacity = depth >= 0 ? 1 : 0.35;
    });
  };
  const turn = (right, up) => {
    azimuth -= right;
    elevation = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, elevation + up));
    draw();
  };
  globe.addEventListener("pointerdown", (event) => globe.setPointerCapture(event.pointerId));
  globe.addEventListener("pointermove", (event) => {
    if (globe.hasPointerCapture(event.pointerId)) turn(event.movementX / 140, event.movementY / 140);
  });
  globe.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!by) return;
    event.preventDefault();
    turn(...by);
  });
}
