"use strict";
(function () {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)");
  const plots = Array.from(document.querySelectorAll(".plot"));
  const phone = window.matchMedia("(max-width: 700px)");
  let printing = false;
  let unfolded = [];

  // Colours by role, in the theme of the page; paper is always light.
  function palette() {
    return data.palettes[!printing && dark.matches ? "dark" : "light"];
  }

  function coloured(value, colours) {
    if (typeof value === "string") {
      return value.startsWith("role:") ? colours[value.slice(5)] : value;
    }
    if (Array.isArray(value)) {
      return value.map((entry) => coloured(entry, colours));
    }
    if (value && typeof value === "object") {
      const copy = {};
      for (const key of Object.keys(value)) copy[key] = coloured(value[key], colours);
      return copy;
    }
    return value;
  }

  function merged(base, more) {
    const result = Object.assign({}, base);
    for (const key of Object.keys(more)) {
      const both = [result[key], more[key]].every((v) => v && typeof v === "object" && !Array.isArray(v));
      result[key] = both ? merged(result[key], more[key]) : more[key];
    }
    return result;
  }

  function layoutOf(panel, colours) {
    const axis = {
      gridcolor: colours.grid, zerolinecolor: colours.grid, linecolor: colours.muted, tickcolor: colours.muted,
      tickfont: { size: 11, color: colours.muted }, title: { font: { size: 12, color: colours.text }, standoff: 6 },
      exponentformat: "power", minorloglabels: "none", nticks: 6, separatethousands: true, hoverformat: ".5~g",
    };
    const base = {
      height: panel.height, autosize: true, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: colours.text },
      margin: { l: 52, r: 14, t: 8, b: 42 }, showlegend: false, dragmode: touch.matches ? false : "zoom",
      hovermode: "x unified", hoverlabel: { bgcolor: colours.card, bordercolor: colours.grid, font: { color: colours.text } },
      xaxis: merged(axis, { automargin: true }), yaxis: merged(axis, { automargin: true }),
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colours.muted, activecolor: colours.text },
    };
    return merged(base, coloured(panel.layout, colours));
  }

  function tracesOf(panel, hidden, colours) {
    return panel.traces.map((trace) => {
      const shown = coloured(trace, colours);
      if (hidden.has(trace.legendgroup)) shown.visible = false;
      if (shown.type === "heatmap" && phone.matches && !printing) narrowed(shown);
      if (shown.type === "heatmap") shown.colorbar = merged(shown.colorbar || {}, { tickfont: { color: colours.muted } });
      return shown;
    });
  }

  // On a phone, cells with a number need no scale beside them, and correlations few characters.
  function narrowed(trace) {
    if (!trace.texttemplate) return;
    trace.showscale = false;
    trace.textfont = { size: trace.z.length > 8 ? 8 : 10 };
    if (trace.meta === "correlation") {
      const short = (value) => value === null ? "" : value.toFixed(2).replace("0.", ".").replace("-", "−");
      trace.text = trace.z.map((row) => row.map(short));
      trace.texttemplate = "%{text}";
    }
  }

  // On a phone, a table that is too wide becomes one block per row; one with very many columns is scrolled.
  function fitTables() {
    for (const table of document.querySelectorAll(".scroll > table")) {
      table.classList.remove("stacked");
      const wide = table.scrollWidth > table.parentElement.clientWidth + 1;
      const columns = table.tHead.rows[table.tHead.rows.length - 1].cells.length;
      if (wide && phone.matches && !printing && columns <= 12) table.classList.add("stacked");
    }
  }

  function hiddenOf(node) {
    const keys = node.closest(".group").querySelectorAll('button[aria-pressed="false"]');
    const own = Array.from(keys).filter((key) => !key.closest("figure") || key.closest("figure").contains(node));
    return new Set(own.map((key) => key.dataset.name));
  }

  const settings = {
    responsive: true, displaylogo: false, displayModeBar: touch.matches ? false : "hover", doubleClick: "reset",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
    showSendToCloud: false, plotlyServerURL: "",
  };

  function draw(node) {
    if (!node.clientWidth) return Promise.resolve();
    const panel = data.panels[Number(node.dataset.panel)];
    const colours = palette();
    const layout = layoutOf(panel, colours);
    // A sheet of paper is narrower than the window, and does not resize what is drawn on it.
    if (printing) {
      layout.autosize = false;
      layout.width = node.closest("figure").classList.contains("wide") ? 690 : 335;
    }
    const before = node._fullLayout;
    // A zoom survives a change of the theme.
    if (before) {
      for (const name of ["xaxis", "yaxis"]) {
        if (!before[name].autorange && !(panel.layout[name] && panel.layout[name].range)) layout[name].range = before[name].range.slice();
      }
    }
    return Plotly.react(node, tracesOf(panel, hiddenOf(node), colours), layout, settings).then(() => {
      if (!before && panel.linked) node.on("plotly_relayout", (event) => follow(node, panel.linked, event));
      node.dataset.drawn = "yes";
    });
  }

  // Plots over the same quantity show the same range.
  let following = false;
  function follow(source, word, event) {
    const isReset = event["xaxis.autorange"] === true;
    const isZoom = event["xaxis.range[0]"] !== undefined;
    if (following || !(isReset || isZoom)) return;
    following = true;
    const change = isReset ? { "xaxis.autorange": true }
      : { "xaxis.range[0]": event["xaxis.range[0]"], "xaxis.range[1]": event["xaxis.range[1]"] };
    const others = plots.filter((node) => node !== source && node._fullLayout && data.panels[Number(node.dataset.panel)].linked === word);
    Promise.all(others.map((node) => Plotly.relayout(node, change))).finally(() => { following = false; });
  }

  function drawAll(nodes) {
    // A plot that fails does not keep the others away.
    const failed = (node) => (error) => { console.error(error); node.textContent = "This plot could not be drawn."; };
    return nodes.reduce((work, node) => work.then(() => draw(node)).catch(failed(node)).then(() => new Promise((next) => setTimeout(next, 0))), Promise.resolve());
  }

  for (const key of document.querySelectorAll(".keys button")) {
    key.addEventListener("click", () => {
      key.setAttribute("aria-pressed", key.getAttribute("aria-pressed") === "true" ? "false" : "true");
      const scope = key.closest("figure") || key.closest(".group");
      scope.querySelectorAll(".plot").forEach((node) => { if (node._fullLayout) draw(node); });
    });
  }

  // A folded plot has no size; it is drawn when it is unfolded.
  for (const fold of document.querySelectorAll("details")) {
    fold.addEventListener("toggle", () => {
      if (!fold.open) return;
      fitTables();
      fold.querySelectorAll(".plot").forEach(draw);
    });
  }

  window.addEventListener("resize", fitTables);
  phone.addEventListener("change", () => drawAll(plots.filter((node) => node._fullLayout)));
  dark.addEventListener("change", () => drawAll(plots.filter((node) => node._fullLayout)));
  window.addEventListener("beforeprint", () => {
    printing = true;
    unfolded = Array.from(document.querySelectorAll("details:not([open])"));
    unfolded.forEach((fold) => { fold.open = true; });
    fitTables();
    plots.forEach(draw);
  });
  window.addEventListener("afterprint", () => {
    printing = false;
    unfolded.forEach((fold) => { fold.open = false; });
    fitTables();
    document.body.dataset.busy = "yes";
    drawAll(plots.filter((node) => node._fullLayout)).then(() => { delete document.body.dataset.busy; });
  });

  // The video plays by itself, without sound, unless the reader prefers a page that stands still.
  if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) {
    document.querySelectorAll("video").forEach((video) => { video.play().catch(() => {}); });
  }

  fitTables();
  drawAll(plots).then(() => { document.body.dataset.ready = "yes"; });
})();
