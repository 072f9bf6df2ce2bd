"""Style sheet of the page of `qc`, and its script, which sorts tables and opens plots."""

STYLE = """
:root { color-scheme: light dark; --line: #8884; --good: #1a7f37; --doubt: #c2570c; --no: #cf222e; }
body { font: 15px/1.45 system-ui, sans-serif; max-width: 76rem; margin: 1.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.2rem; margin-top: 2rem; } h3 { font-size: 1rem; }
p { margin: .3rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: middle; }
th { position: sticky; top: 0; background: Canvas; }
th button { all: unset; cursor: pointer; font-weight: 600; }
th button:focus-visible { outline: 2px solid; }
th[aria-sort=ascending] button::after { content: " \\25B2"; }
th[aria-sort=descending] button::after { content: " \\25BC"; }
td:has(img) { padding: .1rem .6rem; }
td.doubt, p.doubt { color: var(--doubt); font-weight: 600; }
details { border: 1px solid var(--line); border-radius: 6px; margin: .6rem 0; padding: .4rem .8rem; }
summary { cursor: pointer; font-weight: 600; }
img.stalk { height: 96px; display: block; } img.stalk:hover { height: 240px; }
figure { margin: .5rem 0; } figcaption { opacity: .75; }
img.pair { max-width: 100%; }
svg { max-width: 900px; width: 100%; font-size: 12px; } svg text { fill: currentColor; }
svg .grid { stroke: var(--line); } svg .good { fill: var(--good); stroke: var(--good); }
svg .doubt { fill: var(--doubt); stroke: var(--doubt); } svg text.no { fill: var(--no); font-size: 16px; }
@media print { details { break-inside: avoid; } }
"""

SCRIPT = """
document.querySelectorAll("th button").forEach(button => button.addEventListener("click", () => {
  const head = button.closest("th"), body = head.closest("table").tBodies[0], column = head.cellIndex;
  const up = head.getAttribute("aria-sort") !== "ascending";
  head.parentNode.querySelectorAll("th").forEach(each => each.setAttribute("aria-sort", "none"));
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const of = row => row.cells[column].textContent.trim();
  const rows = [...body.rows].sort((a, b) => {
    const [x, y] = [of(a), of(b)];
    if (x === "" || y === "") return (x === "") - (y === "");
    const difference = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en", { numeric: true }) : x - y;
    return up ? difference : -difference;
  });
  body.append(...rows);
}));
const show = () => {
  const found = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (found) found.open = true;
};
addEventListener("hashchange", show);
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(each => { each.open = true; }));
const plots = document.querySelectorAll("details");
if (plots.length === 1) plots[0].open = true; else show();
"""
