// What a cell shows, without its small print, and its value: "+5", "−12", "5,030", "58 %", "7–9" count as numbers.
const shown = cell =>
  [...cell.childNodes].filter(node => node.nodeName !== 'SMALL').map(node => node.textContent).join(' ').trim();
const number = text => parseFloat(text.replace('\u2212', '-').replace(/,(?=\d{3})/g, ''));
const missing = text => text === '' || text === '\u2013';

function sorted(rows, column, direction) {
  if (direction === 'none') return rows;
  const keyed = rows.map(row => [shown(row.cells[column]), row]);
  const known = keyed.filter(([text]) => !missing(text));
  const numbers = known.every(([text]) => !isNaN(number(text)));
  const sign = direction === 'ascending' ? 1 : -1;
  known.sort(([a], [b]) => sign * (numbers ? number(a) - number(b) : a.localeCompare(b, 'en', {numeric: true})));
  return [...known, ...keyed.filter(([text]) => missing(text))].map(([, row]) => row);
}

// The first body sorts by the column whose head is clicked: up, down, as it was. Bodies below it stay.
function sortable(table) {
  const body = table.tBodies[0], rows = [...body.rows];
  const heads = [...table.tHead.querySelectorAll('th:not([colspan])')];
  const following = {none: 'ascending', ascending: 'descending', descending: 'none'};
  heads.forEach((head, column) => {
    if (rows.length < 2 || !head.textContent) return;
    const button = document.createElement('button');
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute('aria-sort', 'none');
    button.addEventListener('click', () => {
      const next = following[head.getAttribute('aria-sort')];
      for (const other of table.tHead.querySelectorAll('th[aria-sort]')) other.setAttribute('aria-sort', 'none');
      head.setAttribute('aria-sort', next);
      body.append(...sorted(rows, column, next));
    });
  });
}

// An item is shown if it has what every list names: the value "policy:bc" asks for data-policy="bc".
function filtered(block) {
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

function choosing(block) {
  const list = block.querySelector('select'), parts = [...block.querySelectorAll('.chosen')];
  const apply = () => {
    parts.forEach((part, i) => { part.hidden = i !== list.selectedIndex; });
    // Figures that were hidden take their size now.
    dispatchEvent(new Event('resize'));
  };
  list.addEventListener('change', apply);
  apply();
}

function copying(button) {
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

document.querySelectorAll('table.sortable').forEach(sortable);
document.querySelectorAll('.filters').forEach(filtered);
document.querySelectorAll('.choice').forEach(choosing);
document.querySelectorAll('button.copy').forEach(copying);
