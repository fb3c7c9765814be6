// What all charts share, and the chart of the finding.
"use strict";

const charts = {
  // The look of a chart in the colours of the page.
  layout(extra) {
    const style = getComputedStyle(document.body);
    const grid = theme.dark() ? "rgba(255,255,255,0.13)" : "rgba(0,0,0,0.10)";
    const zero = theme.dark() ? "rgba(255,255,255,0.55)" : "rgba(0,0,0,0.55)";
    const axis = { gridcolor: grid, zerolinecolor: zero, linecolor: grid, automargin: true };
    return {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: style.fontFamily, size: 13, color: style.color },
      hoverlabel: { font: { family: style.fontFamily } },
      ...extra,
      xaxis: { ...axis, ...extra.xaxis },
      yaxis: { ...axis, ...extra.yaxis },
    };
  },
  // A sampler's colour. Black is the colour of text, which is light on a dark page.
  colour(sampler) {
    const { colour } = data.samplers[sampler] || { colour: "#888888" };
    return colour === "#000000" ? getComputedStyle(document.body).color : colour;
  },
  options: { displayModeBar: false, responsive: true },
  fill(select, names, kept) {
    select.replaceChildren(...names.map(([value, text]) => new Option(text, value)));
    if (names.some(([value]) => String(value) === kept)) select.value = kept;
  },
};

(() => {
  const at = (id) => document.getElementById(id);
  const [figure, panel, maze] = ["figure", "panel", "maze"].map((name) => at(`chart-${name}`));
  const once = (values) => [...new Set(values)].map((value) => [value, value]);
  const of = (entry) => entry.figure === figure.value;
  const offer = () => {
    const here = data.differences.filter(of);
    charts.fill(panel, once(here.map((entry) => entry.panel)), panel.value);
    const inPanel = here.filter((entry) => entry.panel === panel.value);
    charts.fill(maze, once(inPanel.map((entry) => entry.maze)), maze.value);
  };
  const draw = () => {
    const chosen = data.differences.find(
      (entry) => of(entry) && entry.panel === panel.value && entry.maze === maze.value
    );
    const { bars } = chosen;
    const narrow = at("chart").clientWidth < 560;
    const side = (bar) => (bar.low > 0 ? "#009E73" : bar.high < 0 ? "#D55E00" : "#8a94a0");
    const trace = {
      type: "scatter",
      mode: "markers",
      x: bars.map((bar) => bar.middle),
      y: bars.map((bar) => (narrow ? bar.name.replace(/, /g, ",<br>") : bar.name)),
      marker: { size: 10, color: bars.map(side) },
      error_x: {
        type: "data",
        symmetric: false,
        array: bars.map((bar) => bar.high - bar.middle),
        arrayminus: bars.map((bar) => bar.middle - bar.low),
        color: theme.dark() ? "#9aa4af" : "#59636e",
        thickness: 1.8,
        width: 5,
      },
      customdata: bars.map((bar) => [bar.low, bar.high]),
      hovertemplate: "%{x:.2f} [%{customdata[0]:.2f}, %{customdata[1]:.2f}]<extra>%{y}</extra>",
    };
    const layout = charts.layout({
      height: 80 + bars.length * (narrow ? 40 : 33),
      margin: { l: 10, r: 12, t: 8, b: 44 },
      xaxis: { title: { text: "mean area minus ASER's" }, zerolinewidth: 2, fixedrange: true },
      yaxis: { fixedrange: true },
      showlegend: false,
    });
    Plotly.react(at("chart"), [trace], layout, charts.options);
  };
  charts.fill(figure, once(data.differences.map((entry) => entry.figure)), "");
  offer();
  for (const select of [figure, panel, maze]) {
    select.addEventListener("input", () => {
      offer();
      draw();
    });
  }
  document.addEventListener("theme", draw);
})();
