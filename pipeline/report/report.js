"use strict";
(function () {
  const root = document.documentElement;
  const printing = location.hash === "#print"; // `pipeline report --pdf` opens the page like this
  const config = { displaylogo: false, responsive: !printing, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
  const stored = (id) => JSON.parse(document.getElementById(id).textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const night = stored("night"); // colours of plots on paper -> on a dark screen
  const poses = stored("poses");
  const plots = Array.from(document.querySelectorAll(".plot"));
  const PAPER_WIDTH = 700; // px of a page in portrait
  let chosen = null;
  let onPaper = printing;
  let drawn = 0;
  root.dataset.plots = String(plots.length);
  root.dataset.drawn = "0";
  if (printing) root.classList.add("print");

  // ---- the plots: drawn one after the other, so that the top of the page can be read at once
  async function library() {
    const packed = document.getElementById("library");
    if (!packed) return;
    const bytes = Uint8Array.from(atob(packed.textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    packed.remove();
  }
  const atNight = () => dark.matches && !onPaper;
  const textOf = (div) => div.parentNode.querySelector('script[type="application/json"]').textContent;
  function figureOf(div) {
    const figure = JSON.parse(textOf(div), (key, value) => (atNight() && typeof value === "string" && night[value.toUpperCase()]) || value);
    const narrow = !onPaper && root.clientWidth < 600 ? { margin: { ...figure.layout.margin, l: Math.min(48, figure.layout.margin.l), r: 8 } } : {};
    const size = onPaper ? { width: Math.min(PAPER_WIDTH, div.clientWidth || PAPER_WIDTH), height: div.clientHeight } : {};
    return { data: marked(figure.data), layout: { ...figure.layout, uirevision: "kept", ...narrow, ...size } };
  }
  async function draw(div) {
    const figure = figureOf(div);
    await (div.dataset.state ? Plotly.react(div, figure.data, figure.layout, config) : Plotly.newPlot(div, figure.data, figure.layout, config));
    if (div.dataset.state) return;
    div.dataset.state = "drawn";
    div.on("plotly_click", function (event) {
      const told = event.points.map((p) => p.customdata).filter((c) => c !== undefined && c !== null);
      if (told.length) choose([].concat(told[0]).pop());
    });
    if (printing && div.querySelector("canvas")) {
      const picture = new Image(); // a canvas of WebGL is blank on paper
      picture.src = await Plotly.toImage(div, { format: "png", width: div.clientWidth, height: div.clientHeight, scale: 2 });
      picture.alt = div.getAttribute("aria-label");
      Plotly.purge(div);
      div.replaceChildren(picture);
    }
    drawn += 1;
    root.dataset.drawn = String(drawn);
  }
  const all = () => plots.filter((d) => d.dataset.state === "drawn" && typeof Plotly !== "undefined").forEach(draw);
  async function start() {
    await library();
    for (const div of plots) {
      await draw(div);
      await new Promise((next) => setTimeout(next, 0));
    }
  }

  // ---- a pose: in every plot, its rows and its images
  const rowsOf = (trace) => (trace.customdata || []).flatMap((c, i) => ([].concat(c).includes(chosen) ? [i] : []));
  function marked(traces) {
    if (chosen === null) return traces;
    const colour = atNight() ? "#FF5CA8" : "#C2005B";
    const more = [];
    const own = traces.map(function (trace) {
      const rows = rowsOf(trace);
      if (!rows.length) return trace;
      if (trace.type === "bar") return { ...trace, selectedpoints: rows, unselected: { marker: { opacity: 0.3 } } };
      const some = {};
      for (const key of ["x", "y", "z", "text"]) if (Array.isArray(trace[key])) some[key] = rows.map((i) => trace[key][i]);
      const size = ((trace.marker || {}).size || 5) + 5;
      more.push({ ...trace, ...some, customdata: undefined, error_y: undefined, opacity: 1, showlegend: false, name: "chosen pose", line: { color: colour, width: ((trace.line || {}).width || 1) + 2 }, marker: { ...trace.marker, color: colour, size: size, opacity: 1, showscale: false, colorscale: undefined, line: { color: "#FFFFFF", width: 1.5 } } });
      return trace;
    });
    return own.concat(more);
  }
  const list = document.getElementById("pose");
  const told = document.getElementById("chosen");
  function choose(pose) {
    chosen = pose === chosen ? null : pose;
    root.dataset.chosen = chosen === null ? "" : String(chosen);
    let images = 0;
    let rows = 0;
    document.querySelectorAll("[data-pose]").forEach(function (element) {
      const mine = chosen !== null && element.dataset.pose === String(chosen);
      element.classList.toggle("chosen", mine);
      if (mine && element.tagName === "FIGURE") images += 1;
      if (mine && element.tagName === "TR") rows += 1;
    });
    all();
    if (!list) return;
    list.value = chosen === null ? "" : String(chosen);
    const shown = plots.filter((d) => chosen !== null && JSON.parse(textOf(d)).data.some((trace) => rowsOf(trace).length)).length;
    document.getElementById("toimages").hidden = images === 0;
    told.textContent = chosen === null ? "" : `${poses[chosen]}: marked in ${shown} plots, ${rows} rows, ${images} images`;
  }
  if (list) {
    list.addEventListener("change", () => { chosen = null; choose(list.value === "" ? null : Number(list.value)); });
    const step = (by) => { const at = Math.max(0, Math.min(list.options.length - 1, list.selectedIndex + by)); list.selectedIndex = at; list.dispatchEvent(new Event("change")); };
    document.getElementById("earlier").addEventListener("click", () => step(-1));
    document.getElementById("later").addEventListener("click", () => step(1));
    document.getElementById("none").addEventListener("click", () => { if (chosen !== null) choose(chosen); });
    document.addEventListener("keydown", (event) => { if (event.key === "Escape" && chosen !== null && !document.querySelector("dialog[open]")) choose(chosen); });
  }
  document.querySelectorAll("button[data-choose]").forEach((b) => b.addEventListener("click", () => choose(Number(b.dataset.choose))));

  // ---- a picture: large, with what is known of a mark
  const viewer = document.getElementById("viewer");
  function look(figure) {
    const place = viewer.querySelector(".sheet");
    const picture = figure.querySelector("svg").cloneNode(true);
    place.replaceChildren(picture);
    picture.style.width = "100%";
    viewer.querySelector("h2").textContent = figure.querySelector("figcaption").textContent;
    const line = viewer.querySelector("output");
    line.textContent = "Choose a mark to read its numbers.";
    picture.querySelectorAll(".mark").forEach(function (mark) {
      const text = mark.querySelector("title").textContent;
      mark.setAttribute("tabindex", "0");
      mark.setAttribute("role", "img");
      mark.setAttribute("aria-label", text);
      for (const kind of ["click", "focus", "mouseenter"]) mark.addEventListener(kind, () => { line.textContent = text; });
    });
    viewer.showModal();
  }
  if (viewer) {
    document.querySelectorAll("button.look").forEach((b) => b.addEventListener("click", () => look(b.closest("figure"))));
    document.querySelectorAll("figure.seen > svg").forEach((s) => s.addEventListener("click", () => look(s.parentNode)));
    viewer.querySelectorAll("input[type=checkbox]").forEach((box) => box.addEventListener("change", () => viewer.classList.toggle("no-" + box.name, !box.checked)));
    viewer.querySelectorAll("button[data-zoom]").forEach((b) => b.addEventListener("click", function () {
      const picture = viewer.querySelector("svg");
      picture.style.width = Math.max(100, Math.min(800, parseFloat(picture.style.width) * Number(b.dataset.zoom))) + "%";
    }));
    viewer.querySelector("button.close").addEventListener("click", () => viewer.close());
  }

  // ---- tables, colours, paper
  document.querySelectorAll("button.unfold").forEach((b) => b.addEventListener("click", () => { b.parentNode.classList.add("all"); b.remove(); }));
  function paper(on) {
    onPaper = on;
    root.classList.toggle("print", on);
    if (on) document.querySelectorAll("details:not(.long)").forEach((d) => { d.open = true; });
    all();
  }
  if (printing) document.querySelectorAll("details:not(.long)").forEach((d) => { d.open = true; });
  else {
    addEventListener("beforeprint", () => paper(true));
    addEventListener("afterprint", () => paper(false));
  }
  dark.addEventListener("change", all);
  setTimeout(start, 0);
})();
