"""The look of the reports: one self-contained HTML page with figures that follow the light or dark scheme.

The page loads nothing: plotly.js stands inside, and a content security policy forbids every request. Whatever
is called body or block is HTML already; :func:`text` makes strings from outside harmless.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Sequence
from typing import Any

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

PALETTE = ("#3b7dd8", "#e0782f", "#2f9e77", "#a45bd0", "#c9a227", "#d1495b", "#4fa3b5", "#7d8597")
"""Colours of policies and runs, readable on light and dark ground."""


def color(index: int) -> str:
    """Colour of the policy or run with this place."""
    return PALETTE[index % len(PALETTE)]


TRUE, PREDICTED, PART, STATIC = "#2f9e77", "#e0782f", "#3b7dd8", "#98a2b3"
"""Colours of the viewer: true flow, predicted flow, points of the target part, other points."""

_CSP = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; media-src data:"

_CSS = """
:root { color-scheme: light dark; --ground: #f6f7f9; --panel: #fff; --ink: #1a1f2b; --soft: #5c6575;
  --line: #e1e4ea; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --ground: #12151b; --panel: #1a1f28; --ink: #e7eaf0;
  --soft: #9aa4b5; --line: #2c333f; --bad: #ff8a80; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1160px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; letter-spacing: -.01em; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 40px 0 12px; }
h3 { font-size: 14px; margin: 20px 0 8px; color: var(--soft); font-weight: 600; }
p { margin: 0 0 12px; max-width: 80ch; }
.soft { color: var(--soft); }
code, pre { font: 13px/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; overflow-wrap: anywhere; }
pre { overflow: auto; max-height: 420px; }
dl { display: grid; grid-template-columns: max-content minmax(0, 100ch); gap: 2px 16px; margin: 16px 0 0;
  font-size: 14px; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(210px, 1fr)); gap: 12px; }
.card { background: var(--panel); border: 1px solid var(--line); border-radius: 10px; padding: 12px 14px; }
.card .name { color: var(--soft); font-size: 13px; }
.card .value { font-size: 25px; font-weight: 600; line-height: 1.3; font-variant-numeric: tabular-nums; }
.card .more { color: var(--soft); font-size: 12.5px; font-variant-numeric: tabular-nums; }
.panel { background: var(--panel); border: 1px solid var(--line); border-radius: 10px; padding: 14px; }
.scroll { overflow: auto; max-height: 520px; padding: 0; }
.wide { overflow-x: auto; padding: 0; }
table { border-collapse: collapse; width: 100%; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 9px; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--soft); font-weight: 600; white-space: normal; vertical-align: bottom; }
th.text, td.text { text-align: left; }
td.wrap { white-space: normal; overflow-wrap: anywhere; min-width: 180px; }
th.group { text-align: center; color: var(--ink); border-bottom: 2px solid var(--swatch, var(--line)); }
td.first, th.first { border-left: 1px solid var(--line); }
tbody tr:last-child td { border-bottom: 0; }
tr.mean td { font-weight: 600; } tr.mean small { font-weight: 400; color: var(--soft); display: block; }
tbody + tbody { border-top: 2px solid var(--line); }
.wide .text:first-child { position: sticky; left: 0; background: var(--panel); }
.scroll thead th { position: sticky; top: 0; background: var(--panel); }
.error { color: var(--bad); }
details { margin-top: 12px; } summary { cursor: pointer; font-weight: 600; margin-bottom: 8px; }
select, button { font: inherit; color: inherit; background: var(--ground); border: 1px solid var(--line);
  border-radius: 7px; padding: 5px 10px; max-width: 100%; }
.bar { display: flex; flex-wrap: wrap; gap: 8px 12px; align-items: center; margin-bottom: 8px; }
.pair { display: grid; grid-template-columns: 1fr 1fr; text-align: center; font-weight: 600;
  margin-top: 12px; }
.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin-right: 5px; }
.legend { color: var(--soft); font-size: 13px; display: flex; flex-wrap: wrap; gap: 4px 14px; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 430px), 1fr)); gap: 12px;
  margin-top: 10px; }
.grid.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 260px), 1fr)); }
.grid > * { min-width: 0; }
figure { margin: 0; } figcaption { color: var(--soft); font-size: 13px; margin-top: 6px; overflow-wrap: anywhere; }
td.named { padding-left: 26px; white-space: normal; max-width: 300px; overflow-wrap: break-word; }
td.named .dot { float: left; margin: 5px 0 0 -17px; }
video, figure img { width: 100%; border-radius: 6px; display: block; background: #fff; }
@media (max-width: 600px) {
  main { padding: 20px 12px 48px; } .panel { padding: 8px; } .wide, .scroll { padding: 0; }
  dl { grid-template-columns: minmax(0, 1fr); } dd { margin-bottom: 6px; }
  .cards { grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 8px; } .card .value { font-size: 21px; }
  th, td { padding: 5px 7px; }
  .wide .text:first-child { white-space: normal; overflow-wrap: break-word; max-width: 150px; }
}
"""

# Figures are drawn transparent; their ink comes from the page's CSS variables, again when the scheme changes.
_THEME_JS = """
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
"""

_VIEWER_JS = """
const view = JSON.parse(document.getElementById('clouds').textContent);
const choice = document.getElementById('cloud-choice');
const frame = {showticklabels: false, title: {text: ''}, showspikes: false, zeroline: false, showgrid: false,
  showbackground: false};
// PartNet-Mobility's objects face -x. Narrow scenes are seen from further away, so that nothing is cut off.
const startCamera = () => {
  const far = Math.max(1.08, 1080 / document.getElementById('viewer').clientWidth);
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
  const scene = (left, right) => ({domain: {x: [left, right]}, aspectmode: 'manual', aspectratio, camera,
    dragmode: 'orbit',
    xaxis: {...frame, range: cloud.box[0]}, yaxis: {...frame, range: cloud.box[1]},
    zaxis: {...frame, range: cloud.box[2]}});
  viewer.data = ['scene', 'scene2'].flatMap((s, k) => [
    dots(cloud.rest, view.colors.rest, s), dots(cloud.part, view.colors.part, s),
    ...(k ? arrows(cloud.predicted, view.colors.predicted, s, cloud.size)
          : arrows(cloud.true, view.colors.true, s, cloud.size))]);
  viewer.layout = {height: 520, margin: {l: 0, r: 0, t: 0, b: 0}, scene: scene(0, 0.495),
    scene2: scene(0.505, 1)};
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
"""


def text(value: object) -> str:
    """A string from outside as HTML that shows it literally."""
    return html.escape(str(value))


def _json(value: object) -> str:
    # "<" would let a string close the script element.
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def figure(id_: str, plot: go.Figure) -> str:
    """A plotly figure as a block of the page."""
    return (
        f'<div class="panel"><div id="{id_}"></div></div>'
        f'<script type="application/json" data-figure="{id_}">{_safe_figure(plot)}</script>'
    )


def _safe_figure(plot: go.Figure) -> str:
    content: str = plot.to_json()  # turns NaN to null, unlike json
    return content.replace("<", "\\u003c")


def viewer(clouds: Sequence[dict[str, Any]]) -> str:
    """Two linked 3D scenes, true next to predicted flow.

    Args:
        clouds: per cloud "title"; "rest" and "part": coordinates of the points as [3][n] lists; "true" and
            "predicted": {"start": [a][3], "vector": [a][3]}; "box": range of each axis, [3][2]; "size":
            length (m) at which a flow of norm 1 is drawn.
    """
    colors = {"rest": STATIC, "part": PART, "true": TRUE, "predicted": PREDICTED}
    names = (("part to open", PART), ("other points", STATIC), ("true flow", TRUE), ("predicted flow", PREDICTED))
    content = _json({"clouds": list(clouds), "colors": colors})
    return (
        '<div class="panel"><div class="bar"><button id="cloud-back" aria-label="previous cloud">‹</button>'
        '<select id="cloud-choice" aria-label="cloud"></select>'
        '<button id="cloud-next" aria-label="next cloud">›</button>'
        f'<button id="cloud-reset">reset view</button></div>{legend(names)}'
        '<div class="pair"><div>true flow</div><div>predicted flow</div></div><div id="viewer"></div></div>'
        f'<script type="application/json" id="clouds">{content}</script>'
    )


def grid(blocks: Iterable[str], size: str = "") -> str:
    """Blocks side by side, as many as fit; ``size`` "small" fits more of them."""
    return f'<div class="grid {size}">{"".join(blocks)}</div>'


def video(title: str, content: bytes) -> str:
    """An MP4 file inside the page."""
    data = base64.b64encode(content).decode("ascii")
    return (
        f'<figure class="panel"><video controls muted loop playsinline preload="metadata" '
        f'src="data:video/mp4;base64,{data}"></video><figcaption>{text(title)}</figcaption></figure>'
    )


def swatch(shade: str) -> str:
    """A dot in a policy's colour."""
    return f'<span class="dot" style="background:{shade}"></span>'


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """Names with their colours, for several figures; plain text."""
    return (
        f'<div class="legend">{"".join(f"<span>{swatch(shade)}{text(name)}</span>" for name, shade in entries)}</div>'
    )


def cards(entries: Iterable[tuple[str, str, Sequence[str]]]) -> str:
    """Headline numbers: (name, value, lines of small print) each, plain text."""
    return (
        '<div class="cards">'
        + "".join(
            f'<div class="card"><div class="name">{text(name)}</div><div class="value">{text(value)}</div>'
            f'<div class="more">{"<br>".join(map(text, more))}</div></div>'
            for name, value, more in entries
        )
        + "</div>"
    )


def facts(entries: Iterable[tuple[str, object]]) -> str:
    """A list of names and values, plain text."""
    return "<dl>" + "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in entries) + "</dl>"


def section(title: str, *blocks: str) -> str:
    """A titled section; nothing at all if every block is empty."""
    content = "".join(blocks)
    return f"<section><h2>{text(title)}</h2>{content}</section>" if content else ""


def page(title: str, body: str) -> str:
    """The whole page. ``title`` is plain text, ``body`` HTML made by this module."""
    figures = "data-figure=" in body
    clouds = 'id="viewer"' in body
    scripts = f"<script>{get_plotlyjs()}</script>" if figures or clouds else ""
    scripts += f"<script>{_THEME_JS}{_VIEWER_JS if clouds else ''}</script>" if scripts else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_CSP}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{_CSS}</style></head>"
        f"<body><main>{body}</main>{scripts}</body></html>\n"
    )
