"""The style of a certificate: A4 pages with number and page count, and a sheet on the screen."""

_PAGES = """
@page {{ size: A4; margin: 20mm 16mm 18mm 20mm;
  @top-left {{ content: {title}; font: 8.5pt {font}; color: #333; }}
  @top-right {{ content: {mark}; font: bold 8.5pt {font}; color: #b3261e; }}
  @bottom-left {{ content: {laboratory}; font: 8.5pt {font}; color: #333; }}
  @bottom-right {{ content: "page " counter(page) " of " counter(pages);
    font: 8.5pt {font}; color: #333; }} }}
"""
_FONT = '"DejaVu Sans", Arial, sans-serif'
_SHEET = """
* { box-sizing: border-box; }
html { background: #e9ebee; }
body { font: 10pt/1.4 "DejaVu Sans", Arial, sans-serif; color: #111; background: #fff;
  max-width: 190mm; margin: 8mm auto; padding: 16mm 18mm; }
h1 { font-size: 19pt; margin: 0; }
h2 { font-size: 12pt; margin: 16pt 0 5pt; border-bottom: 1px solid #111; break-after: avoid; }
h3 { font-size: 10pt; margin: 9pt 0 2pt; break-after: avoid; }
p { margin: 4pt 0; overflow-wrap: anywhere; }
ul { margin: 4pt 0; padding-left: 14pt; }
.head { display: flex; flex-wrap: wrap; justify-content: space-between; gap: 6pt 20pt;
  border-bottom: 2px solid #111; padding-bottom: 8pt; margin-bottom: 8pt; }
.head .number { font-size: 13pt; font-weight: bold; }
.draft { border: 2px solid #b3261e; color: #b3261e; padding: 6pt 9pt; margin: 8pt 0; }
.missing { color: #b3261e; font-weight: bold; }
table { border-collapse: collapse; width: 100%; margin: 3pt 0;
  font-variant-numeric: tabular-nums; }
th, td { padding: 1.5pt 5pt; text-align: left; vertical-align: top; }
th { font-size: 8.5pt; border-bottom: 1px solid #888; }
td { border-bottom: 1px solid #ddd; }
th.r, td.r { text-align: right; white-space: nowrap; }
.facts th { width: 30%; font-weight: normal; color: #333; border-bottom: 1px solid #ddd; }
.facts td { overflow-wrap: anywhere; }
.budget th, .budget td { padding: 0 3pt; font-size: 7.4pt; }
.note { font-size: 8.5pt; color: #333; }
.wide { overflow-x: auto; }
.signatures { display: flex; flex-wrap: wrap; gap: 20pt; margin-top: 34pt; break-inside: avoid; }
.signatures div { flex: 1 1 55mm; border-top: 1px solid #111; padding-top: 3pt; }
tr, .whole { break-inside: avoid; }
@media print {
  html, body { background: #fff; }
  body { max-width: none; margin: 0; padding: 0; font-size: 9.2pt; }
  .wide { overflow: visible; }
}
@media screen and (max-width: 700px) {
  body { margin: 0; padding: 14px; }
  .facts th { width: 38%; }
  .wide table { font-size: 7.6pt; }
  .wide th { font-size: 7pt; }
  .wide th, .wide td { padding: 1.5pt 2pt; }
}
"""


def style(title: str, laboratory: str, mark: str) -> str:
    """Return the style of a certificate.

    Args:
        title: On top of every printed page; contains the number.
        laboratory: At the bottom of every printed page.
        mark: On top of every printed page of a draft, else empty.
    """
    texts = {'title': title, 'laboratory': laboratory, 'mark': mark}
    quoted = {name: _quoted(text) for name, text in texts.items()}
    return _PAGES.format(font=_FONT, **quoted) + _SHEET


def _quoted(text: str) -> str:
    """Return a text as a string of CSS, escaped so that it cannot end its string or element."""
    kept = ''.join(c if c.isalnum() or c in ' .,-' else f'\\{ord(c):x} ' for c in text)
    return f'"{kept}"'
