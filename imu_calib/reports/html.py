"""The style of the report on a screen, light or dark, on a phone, and on A4 paper."""

_LIGHT = """
  --page: #e9ebee; --paper: #fff; --ink: #1a1a1a; --soft: #444; --faint: #555; --title: #1b3a5c;
  --rule: #999; --hair: #e4e6e9; --panel: #f4f5f7; --grid: #e1e4e8; --frame: #888; --lane: #f1f2f4;
  --good: #00704f; --doubt: #8a5c00; --bad: #b3261e; --mark-doubt: #b87a00;
  --allowed: #dce9f3; --edge: #8fb3cf; --x: #0072b2; --y: #d55e00; --z: #00805c;
  --static: #0a5c94; --turn: #00805c; --rejected: #c2491d;
"""
_DARK = """
  --page: #0e1013; --paper: #181b20; --ink: #e8eaed; --soft: #b9bfc7; --faint: #a3abb5;
  --title: #9cc4ee; --rule: #6b737d; --hair: #2d323a; --panel: #22262d; --grid: #2f353d;
  --frame: #79818c; --lane: #24292f; --good: #00704f; --doubt: #8a5c00; --bad: #b3261e;
  --mark-doubt: #e0a030; --allowed: #23384a; --edge: #4a7596; --x: #5ab4f0; --y: #ff9447;
  --z: #45c79b; --static: #2b7fc0; --turn: #1f9d76; --rejected: #d9653a;
"""

STYLE = (
    f"""
@page {{ size: A4; margin: 14mm 13mm 15mm; }}
:root {{ color-scheme: light dark; {_LIGHT} }}
@media screen and (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
"""
    + """
* { box-sizing: border-box; }
html { background: var(--page); }
body { font: 14px/1.45 system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; color: var(--ink);
  background: var(--paper); max-width: 860px; margin: 24px auto; padding: 36px 46px;
  box-shadow: 0 1px 5px rgba(0, 0, 0, .25); }
h1 { font-size: 25px; line-height: 1.2; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 30px 0 10px; padding-bottom: 4px;
  border-bottom: 2px solid var(--title); color: var(--title); }
h3 { font-size: 14px; margin: 16px 0 4px; }
p { margin: 6px 0; overflow-wrap: anywhere; }
ul { margin: 6px 0; padding-left: 20px; }
li { margin: 3px 0; overflow-wrap: anywhere; }
.subtitle, .note { color: var(--soft); }
.note { font-size: 12.5px; }
.outcome { display: flex; align-items: center; gap: 14px; margin: 18px 0 14px; padding: 12px 16px;
  border-left: 6px solid var(--faint); background: var(--panel); font-size: 15px; }
.outcome.pass { border-color: var(--good); }
.outcome.marginal { border-color: var(--doubt); }
.outcome.fail { border-color: var(--bad); }
.outcome .badge { font-size: 16px; padding: 3px 14px; }
.badge { display: inline-block; min-width: 66px; padding: 0 7px; border-radius: 3px; color: #fff;
  font-weight: 600; font-size: 12px; text-align: center; }
.badge.pass { background: var(--good); }
.badge.marginal { background: var(--doubt); }
.badge.fail { background: var(--bad); }
dl { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px 22px; margin: 10px 0; }
dt { font-size: 12px; color: var(--faint); }
dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
@media print, (min-width: 701px) { .narrow { display: none; } }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; margin: 4px 0; }
th { font-size: 12px; font-weight: 600; color: var(--soft);
  border-bottom: 1px solid var(--rule); }
th, td { padding: 2px 8px; text-align: left; vertical-align: middle; }
td { border-bottom: 1px solid var(--hair); }
th.r, td.r { text-align: right; white-space: nowrap; }
svg { width: 100%; height: auto; display: block; margin: 8px 0; }
table.parameters { table-layout: fixed; }
table.parameters td { padding-top: 1px; padding-bottom: 1px; white-space: nowrap; }
table.parameters th:nth-child(1) { width: 9%; }
table.parameters th:nth-child(2) { width: 18%; }
table.parameters th:nth-child(3) { width: 13%; }
table.parameters th:nth-child(4) { width: 9%; }
table.parameters th:nth-child(5) { width: 10%; }
table.parameters th:nth-child(6) { width: 11%; }
table.parameters th:nth-child(8) { width: 12%; }
table.parameters td:nth-child(8) { padding-left: 2px; padding-right: 0; text-align: right; }
table.parameters.plain { table-layout: auto; }
table.parameters svg { width: 100%; height: 16px; margin: 0; }
table.budget th, table.budget td { padding: 1px 4px; font-size: 12px; }
table.terms th:nth-child(1) { width: 16%; }
table.terms th:nth-child(2) { width: 21%; }
table.terms th:nth-child(3) { width: 9%; }
table.terms th:nth-child(4) { width: 7%; }
table.terms th:nth-child(5) { width: 21%; }
table.facts th { width: 24%; border-bottom: 1px solid var(--hair); vertical-align: top; }
table.facts td { overflow-wrap: anywhere; }
.panels { display: grid; gap: 0 14px; }
.panels.halves { grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); }
.panels.small { grid-template-columns: repeat(auto-fill, minmax(166px, 1fr)); }
.attitudes { display: grid; grid-template-columns: repeat(auto-fill, minmax(118px, 1fr));
  gap: 10px 12px; margin: 10px 0; }
.attitudes figure { margin: 0; text-align: center; font-size: 11.5px; line-height: 1.3; }
.attitudes figure svg { width: 104px; margin: 0 auto 2px; }
.attitudes figcaption { overflow-wrap: anywhere; }
.attitudes small { color: var(--faint); font-size: 10.5px; }
svg text { font: 12px system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; fill: var(--ink); }
svg text.tick { font-size: 11px; fill: var(--soft); }
svg text.inside { font-size: 11px; font-weight: 600; fill: #fff; }
svg text.inside.dark { fill: #1a1a1a; }
svg .share { stroke: var(--paper); stroke-width: .6; }
svg .grid { stroke: var(--grid); }
svg .frame { fill: none; stroke: var(--frame); }
svg .zero { stroke: var(--frame); }
svg .level { stroke: var(--faint); stroke-dasharray: 5 4; }
svg .allowed { fill: var(--allowed); stroke: var(--edge); }
svg .bar { stroke: var(--ink); stroke-width: 2; }
svg .mark { fill: var(--ink); }
svg .mark.pass { fill: var(--good); }
svg .mark.marginal { fill: var(--mark-doubt); }
svg .mark.fail { fill: var(--bad); }
svg .lane { fill: var(--lane); }
svg .static { fill: var(--static); }
svg .turn { fill: var(--turn); }
svg .rejected { fill: var(--rejected); }
svg .of-x { fill: var(--x); }
svg .of-y { fill: var(--y); }
svg .of-z { fill: var(--z); }
svg .line { fill: none; stroke: var(--faint); }
svg .line.of-x { stroke: var(--x); }
svg .line.of-y { stroke: var(--y); }
svg .line.of-z { stroke: var(--z); }
svg .face { stroke: var(--paper); stroke-width: 1.2; fill-opacity: .38; }
svg .face.back { fill-opacity: .16; }
svg .axis-line { stroke-width: 2; }
svg text.letter { font-size: 12px; font-weight: 700; fill: var(--ink); }
@media screen and (prefers-color-scheme: dark) {
  svg .mark.pass { fill: #35c08f; }
  svg .mark.fail { fill: #ff7a6e; }
  .badge.pass { background: #0a7c59; }
  .badge.fail { background: #c4352b; }
}
@media print {
  html, body { background: #fff; }
  body { max-width: none; margin: 0; padding: 0; box-shadow: none; font-size: 9.6pt; }
  h1 { font-size: 17pt; }
  .subtitle { margin: 0; }
  .outcome { margin: 8pt 0; padding: 6pt 10pt; }
  .wide { overflow-x: visible; }
  .wide > svg { max-height: 112mm; }
  h2 { margin-top: 12pt; }
  td { padding-top: 1px; padding-bottom: 1px; }
  table.parameters td { line-height: 1.25; }
  table.budget th, table.budget td { padding: 0 3px; font-size: 7.6pt; }
  table.terms th, table.terms td { padding: 0 4px; font-size: 7.8pt; }
  table.plain th, table.plain td { font-size: 7.8pt; padding: 0 5px; }
  table.facts { font-size: 7.8pt; }
  .provenance { columns: 2; column-gap: 14pt; }
  .provenance table { margin: 0; }
  .provenance td, .provenance th { padding: 0 4px; font-size: 7.4pt; }
  .provenance .across { column-span: all; }
  .panels.halves { grid-template-columns: 1fr 1fr; }
  .panels.small { grid-template-columns: repeat(5, 1fr); gap: 0 6px; }
  .panels svg { margin: 2px 0; }
  .attitudes { grid-template-columns: repeat(6, 1fr); gap: 4pt 6pt; }
  .attitudes figure { font-size: 7.6pt; }
  .attitudes small { font-size: 7pt; }
  .attitudes figure svg { width: 66pt; }
  h2 { font-size: 12.5pt; margin-top: 16pt; break-after: avoid; }
  h3 { break-after: avoid; }
  svg, tr, figure, .outcome, .whole, dl div { break-inside: avoid; }
  section.page { break-before: page; }
  .badge, .outcome, svg { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
@media screen and (max-width: 700px) {
  body { margin: 0; padding: 16px; }
  h1 { font-size: 22px; }
  dl { grid-template-columns: repeat(2, 1fr); }
  .wide > svg { min-width: 620px; }
  .wide > table.plain:not(.stacked) td { white-space: nowrap; }
  table.stacked, table.stacked tbody, table.stacked tr { display: block; }
  table.stacked thead { display: none; }
  table.stacked tr { padding: 5px 0; border-bottom: 1px solid var(--hair); }
  table.stacked td { display: block; border: 0; padding: 0; text-align: left; white-space: normal;
    overflow-wrap: anywhere; }
  table.stacked td:first-child { font-weight: 600; }
  table.stacked td[data-name]::before { content: attr(data-name) ": "; color: var(--faint);
    font-size: 12px; font-weight: 400; }
  table.budget.stacked tr { display: flex; flex-wrap: wrap; gap: 0 12px; }
  table.budget.stacked td { font-size: 13px; }
  table.budget.stacked td:first-child, table.budget.stacked td:nth-child(4):last-child {
    flex-basis: 100%; }
  .broad { display: none; }
  table.facts th { width: 34%; }
  table.parameters.plain th, table.parameters.plain td { padding: 1px 3px; font-size: 13px; }
  table.parameters.limits thead { display: none; }
  table.parameters.limits, table.parameters.limits tbody { display: block; width: auto; }
  table.parameters.limits tr { display: grid; grid-template-columns: auto auto auto 1fr auto;
    align-items: baseline; padding: 6px 0; border-bottom: 1px solid var(--hair); }
  table.parameters.limits td { border: 0; padding: 0 6px 0 0; }
  table.parameters.limits td:nth-child(1) { grid-area: 1 / 1 / 2 / 2; }
  table.parameters.limits td:nth-child(2) { grid-area: 1 / 2 / 2 / 5; color: var(--soft); }
  table.parameters.limits td:nth-child(8) { grid-area: 1 / 5 / 2 / 6; padding: 0; }
  table.parameters.limits td:nth-child(3) { grid-area: 2 / 1 / 3 / 2; text-align: left; }
  table.parameters.limits td svg { width: 150px; }
  table.parameters.limits td:nth-child(4) { grid-area: 2 / 2 / 3 / 3; }
  table.parameters.limits td:nth-child(4)::before { content: "\\b1  "; }
  table.parameters.limits td:nth-child(5) { grid-area: 2 / 3 / 3 / 4; }
  table.parameters.limits td:nth-child(6) { grid-area: 2 / 4 / 3 / 6; text-align: right;
    padding: 0; }
  table.parameters.limits td:nth-child(6)::before { content: "limit "; color: var(--soft); }
  table.parameters.limits td:nth-child(6).none::before { content: ""; }
  table.parameters.limits td:nth-child(7) { grid-area: 3 / 1 / 4 / 6; padding: 2px 0 0; }
}
"""
)
