{
// ---------------------------------------------------------------------------- tables sort by the head that is clicked
// What a cell shows, without its small print.
const shown = cell =>
  [...cell.childNodes].filter(node => node.nodeName !== 'SMALL').map(node => node.textContent).join(' ').trim();
const value = text => parseFloat(text.replace('\u2212', '-').replace(/,(?=\d{3})/g, ''));
const missing = text => text === '' || text === '\u2013';

function sorted(rows, column, direction) {
  if (direction === 'none') return rows;
  const keyed = rows.map(row => [shown(row.cells[column]), row]);
  const known = keyed.filter(([text]) => !missing(text));
  const numbers = known.every(([text]) => !isNaN(value(text)));
  const sign = direction === 'ascending' ? 1 : -1;
  known.sort(([a], [b]) => sign * (numbers ? value(a) - value(b) : a.localeCompare(b, 'en', {numeric: true})));
  return [...known, ...keyed.filter(([text]) => missing(text))].map(([, row]) => row);
}

const following = {none: 'ascending', ascending: 'descending', descending: 'none'};
for (const table of document.querySelectorAll('table.sortable')) {
  const body = table.tBodies[0], rows = [...body.rows];
  if (rows.length < 2) continue;
  const heads = [...table.tHead.querySelectorAll('th:not([colspan])')];
  heads.forEach((head, column) => {
    if (!head.textContent) return;
    const button = document.createElement('button');
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute('aria-sort', 'none');
    button.addEventListener('click', () => {
      const next = following[head.getAttribute('aria-sort')];
      for (const other of heads) other.setAttribute('aria-sort', other === head ? next : 'none');
      body.append(...sorted(rows, column, next));
    });
  });
}

// --------------------------------------------------------------------------------------------- filters and choices
for (const block of document.querySelectorAll('.filters')) {
  const lists = [...block.querySelectorAll('.bar select')], output = block.querySelector('output');
  const items = [...block.querySelectorAll('[data-item]')];
  const count = new Set(items.map(item => item.dataset.item)).size;
  const apply = () => {
    const wanted = lists.filter(list => list.value).map(list => {
      const cut = list.value.indexOf(':');
      return [list.value.slice(0, cut), list.value.slice(cut + 1)];
    });
    const left = new Set();
    for (const item of items) {
      item.hidden = !wanted.every(([field, value]) => item.dataset[field] === value);
      if (!item.hidden) left.add(item.dataset.item);
    }
    output.textContent = `${left.size === count ? '' : `${left.size} of `}${count} ${output.dataset.noun}`;
  };
  for (const list of lists) list.addEventListener('change', apply);
  // A browser may keep what was chosen when the page is loaded again.
  apply();
}

for (const block of document.querySelectorAll('.choice')) {
  const list = block.querySelector('select'), parts = [...block.querySelectorAll('.chosen')];
  const apply = () => {
    parts.forEach((part, i) => { part.hidden = i !== list.selectedIndex; });
    // Figures that were hidden have no size yet.
    dispatchEvent(new Event('resize'));
  };
  list.addEventListener('change', apply);
  if (list.selectedIndex) apply();
}

// ---------------------------------------------------------------------------------------------------------- copying
for (const button of document.querySelectorAll('button.copy')) {
  button.addEventListener('click', async () => {
    const code = button.previousElementSibling;
    getSelection().selectAllChildren(code);
    try {
      await navigator.clipboard.writeText(code.textContent);
      button.textContent = 'copied';
    } catch {
      button.textContent = document.execCommand('copy') ? 'copied' : 'selected';
    }
    setTimeout(() => { button.textContent = 'copy'; }, 2000);
  });
}
}
