const view = JSON.parse(document.getElementById('clouds').textContent);
const choice = document.getElementById('cloud-choice');
const frame = {showticklabels: false, title: {text: ''}, showspikes: false, zeroline: false, showgrid: false,
  showbackground: false};
const narrow = matchMedia('(max-width: 700px)');
// PartNet-Mobility's objects face -x. Scenes that are narrower than high are seen from further away, so that nothing
// is cut off.
const startCamera = () => {
  const far = narrow.matches ? 0.98 : Math.max(1.08, 1080 / document.getElementById('viewer').clientWidth);
  return {eye: {x: -1.1 * far, y: 0.6 * far, z: 0.55 * far}};
};
function dots(points, color, scene, name) {
  return {type: 'scatter3d', mode: 'markers', scene, name, hoverinfo: 'skip', showlegend: false,
    x: points[0], y: points[1], z: points[2], marker: {size: 2, color}};
}
function arrows(flow, color, scene, size) {
  // Shafts as one broken line, heads as cones of one length.
  const shaft = [[], [], []], tip = [[], [], []], along = [[], [], []];
  flow.start.forEach((start, i) => {
    const norm = Math.hypot(...flow.vector[i]);
    for (let k = 0; k < 3; k++) {
      const end = start[k] + size * flow.vector[i][k];
      shaft[k].push(start[k], end, null);
      tip[k].push(end);
      along[k].push(flow.vector[i][k] / norm * size * 0.14);
    }
  });
  return [
    {type: 'scatter3d', mode: 'lines', scene, hoverinfo: 'skip', showlegend: false, x: shaft[0], y: shaft[1],
      z: shaft[2], line: {color, width: 3}},
    {type: 'cone', scene, hoverinfo: 'skip', showscale: false, x: tip[0], y: tip[1], z: tip[2], u: along[0],
      v: along[1], w: along[2], anchor: 'center', sizemode: 'raw', sizeref: 1,
      colorscale: [[0, color], [1, color]], lighting: {ambient: 0.9, diffuse: 0.2, specular: 0}},
  ];
}
const viewer = {data: [], layout: {}};
function show(index, camera) {
  const cloud = view.clouds[index];
  // The ratio comes from the box: by itself each scene would fit its own arrows.
  const extent = cloud.box.map(([low, high]) => high - low), scale = 1.15 / Math.max(...extent);
  const aspectratio = {x: extent[0] * scale, y: extent[1] * scale, z: extent[2] * scale};
  const domains = narrow.matches ? [{x: [0, 1], y: [0.505, 1]}, {x: [0, 1], y: [0, 0.495]}]
    : [{x: [0, 0.495], y: [0, 1]}, {x: [0.505, 1], y: [0, 1]}];
  const scene = domain => ({domain, aspectmode: 'manual', aspectratio, camera, dragmode: 'orbit',
    xaxis: {...frame, range: cloud.box[0]}, yaxis: {...frame, range: cloud.box[1]},
    zaxis: {...frame, range: cloud.box[2]}});
  const title = (text, {x, y}) => ({text: `<b>${text}</b>`, x: (x[0] + x[1]) / 2, y: y[1], xref: 'paper',
    yref: 'paper', yanchor: 'top', showarrow: false, font: {size: 14}});
  viewer.data = ['scene', 'scene2'].flatMap((s, k) => [
    dots(cloud.rest, view.colors.rest, s), dots(cloud.part, view.colors.part, s),
    ...(k ? arrows(cloud.predicted, view.colors.predicted, s, cloud.size)
          : arrows(cloud.true, view.colors.true, s, cloud.size))]);
  viewer.layout = {height: narrow.matches ? 580 : 520, margin: {l: 0, r: 0, t: 0, b: 0},
    scene: scene(domains[0]), scene2: scene(domains[1]),
    annotations: [title('true flow', domains[0]), title('predicted flow', domains[1])]};
  return Plotly.react('viewer', viewer.data, themed(viewer.layout), config);
}
const camera = () => document.getElementById('viewer').layout.scene.camera;
view.clouds.forEach((cloud, i) => choice.add(new Option(cloud.title, i)));
figures.push(['viewer', viewer]);
show(0, startCamera()).then(node => {
  let busy = false;
  // Both scenes turn together.
  node.on('plotly_relayout', change => {
    const moved = change['scene.camera'] || change['scene2.camera'];
    if (!moved || busy) return;
    busy = true;
    Plotly.relayout(node, {'scene.camera': moved, 'scene2.camera': moved}).then(() => { busy = false; });
  });
});
choice.addEventListener('change', () => show(+choice.value, camera()));
const step = by => () => {
  choice.value = (+choice.value + by + view.clouds.length) % view.clouds.length;
  show(+choice.value, camera());
};
document.getElementById('cloud-back').addEventListener('click', step(-1));
document.getElementById('cloud-next').addEventListener('click', step(1));
document.getElementById('cloud-reset').addEventListener('click', () => show(+choice.value, startCamera()));
narrow.addEventListener('change', () => show(+choice.value, startCamera()));
