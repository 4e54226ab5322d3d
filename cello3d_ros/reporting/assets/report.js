"use strict";
const report = JSON.parse(document.getElementById("data").textContent);
const dark = matchMedia("(prefers-color-scheme: dark)");

// The colours of the page, which follow the reader's light or dark theme.
function themed(layout) {
  const style = getComputedStyle(document.documentElement);
  const text = style.getPropertyValue("--text").trim();
  const grid = style.getPropertyValue("--grid").trim();
  const axis = {gridcolor: grid, zerolinecolor: grid, linecolor: grid};
  const all = {
    ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: {color: text, size: 12}, margin: {l: 60, r: 44, t: 10, b: 50},
    modebar: {orientation: "v"},  // in the right margin, clear of the legend
    legend: {orientation: "h", y: 1.02, yanchor: "bottom", itemsizing: "constant"}
  };
  if (layout.scene) {
    all.margin = {l: 0, r: 44, t: 10, b: 0};
    all.scene = {...layout.scene};
    for (const name of ["xaxis", "yaxis", "zaxis"]) {
      all.scene[name] = {...layout.scene[name], ...axis, showbackground: false};
    }
  } else {
    all.xaxis = {...layout.xaxis, ...axis};
    all.yaxis = {...layout.yaxis, ...axis};
  }
  return all;
}

const drawn = new Map();
function draw(id, chart) {
  drawn.set(id, chart);
  return Plotly.react(id, chart.data, themed(chart.layout), {responsive: true, displaylogo: false});
}

const select = document.getElementById("worst");
function show() {
  const pair = report.worst[Number(select.value)];
  const both = [draw("samples", pair.samples)];
  if (pair.clouds) both.push(draw("clouds", pair.clouds));
  return Promise.all(both);
}

const waiting = Object.entries(report.charts).map(([id, chart]) => draw(id, chart));
if (select) {
  select.addEventListener("change", show);
  waiting.push(show());
}
dark.addEventListener("change", () => drawn.forEach((chart, id) => draw(id, chart)));
addEventListener("beforeprint", () => {
  document.querySelectorAll("details").forEach(details => { details.open = true; });
});
Promise.all(waiting).then(() => { document.body.dataset.ready = "yes"; });
