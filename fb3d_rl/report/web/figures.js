// Figures are drawn transparent; their ink comes from the page's CSS variables, again when the scheme changes.
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
function themed(layout) {
  const axis = {gridcolor: css('--line'), zerolinecolor: css('--line'), linecolor: css('--line')};
  const out = {...layout, paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)',
    font: {family: 'system-ui, sans-serif', size: 12, color: css('--ink')}};
  for (const key of Object.keys(layout)) if (/^[xy]axis/.test(key)) out[key] = {...layout[key], ...axis};
  return out;
}
const config = {displayModeBar: false, responsive: true};
const figures = [];
function draw(id, figure) {
  figures.push([id, figure]);
  return Plotly.newPlot(id, figure.data, themed(figure.layout), config);
}
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
  for (const [id, figure] of figures) Plotly.react(id, figure.data, themed(figure.layout), config);
});
for (const node of document.querySelectorAll('script[data-figure]'))
  draw(node.dataset.figure, JSON.parse(node.textContent));
