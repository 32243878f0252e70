// Clicked points of any figure, as the option for the box around them, a little larger.
const picker = document.getElementById('picker'), option = picker.querySelector('code');
const [copy, clear] = picker.querySelectorAll('button');
let picked = [];
function say() {
  const ends = [0, 1, 2].map(k => [Math.min(...picked.map(p => p[k])), Math.max(...picked.map(p => p[k]))]);
  const slack = 0.01 + 0.02 * Math.max(...ends.map(([low, high]) => high - low));
  const corner = (side, sign) => ends.map(pair => (pair[side] + sign * slack).toFixed(3));
  option.textContent = picked.length ? picker.dataset.prefix + [...corner(0, -1), ...corner(1, 1)].join(',') : '';
  copy.hidden = clear.hidden = !picked.length;
}
for (const [id] of figures)
  document.getElementById(id).on('plotly_click', event => {
    const {x, y, z} = event.points[0];
    picked.push([x, y, z]);
    say();
  });
clear.addEventListener('click', () => { picked = []; say(); });
