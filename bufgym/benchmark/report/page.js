// Draws the charts, in the colours that the style sheet has for light or dark, and again when either changes.
(() => {
  "use strict";
  const charts = JSON.parse(document.getElementById("figures").textContent);
  const config = {
    responsive: true,
    displaylogo: false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "zoomIn2d", "zoomOut2d"],
  };

  // A copy of the figure in which every var(--name) is the colour of that name.
  function coloured(node, colours) {
    if (typeof node === "string") {
      return node.replace(/var\((--[a-z-]+)\)/g, (_, name) => colours.getPropertyValue(name).trim());
    }
    if (Array.isArray(node)) return node.map((item) => coloured(item, colours));
    if (node === null || typeof node !== "object") return node;
    return Object.fromEntries(Object.entries(node).map(([key, item]) => [key, coloured(item, colours)]));
  }

  function draw(figure) {
    const selects = [...figure.querySelectorAll("select")];
    const key = selects.map((select) => select.value).join("\n");
    const panels = charts[figure.dataset.chart][key] || [];
    const colours = getComputedStyle(document.documentElement);
    const places = [...figure.querySelectorAll("[data-panel]")];
    places.forEach((place, k) => {
      place.hidden = k >= panels.length;
      if (place.hidden) return;
      const made = coloured(panels[k], colours);
      made.layout.uirevision = key; // what was zoomed stays so when only the colours change
      Plotly.react(place, made.data, made.layout, config);
    });
    figure.querySelector(".nothing").hidden = panels.length > 0;
  }

  const figures = [...document.querySelectorAll("figure[data-chart]")];
  const all = () => figures.forEach(draw);
  figures.forEach((figure) => figure.addEventListener("change", () => draw(figure)));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
  const paper = (on) => () => {
    document.documentElement.classList.toggle("print", on);
    all();
  };
  addEventListener("beforeprint", paper(true));
  addEventListener("afterprint", paper(false));
  all();
})();
