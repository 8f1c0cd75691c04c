"""How the report looks on a screen and on A4 paper."""

STYLE = """
@page { size: A4; margin: 14mm 13mm 15mm; }
* { box-sizing: border-box; }
html { background: #e9ebee; }
body { font: 14px/1.45 system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; color: #1a1a1a;
  background: #fff; max-width: 860px; margin: 24px auto; padding: 36px 46px;
  box-shadow: 0 1px 5px rgba(0, 0, 0, .25); }
h1 { font-size: 25px; line-height: 1.2; margin: 0 0 4px; }
h2 { font-size: 18px; margin: 30px 0 10px; padding-bottom: 4px; border-bottom: 2px solid #1b3a5c;
  color: #1b3a5c; }
h3 { font-size: 14px; margin: 16px 0 4px; }
p { margin: 6px 0; }
ul { margin: 6px 0; padding-left: 20px; }
li { margin: 3px 0; }
.subtitle, .note { color: #444; }
.note { font-size: 12.5px; }
.outcome { display: flex; align-items: center; gap: 14px; margin: 18px 0 14px; padding: 12px 16px;
  border-left: 6px solid #555; background: #f4f5f7; font-size: 15px; }
.outcome.pass { border-color: #00704f; }
.outcome.marginal { border-color: #9a6700; }
.outcome.fail { border-color: #b3261e; }
.outcome .badge { font-size: 16px; padding: 3px 14px; }
.badge { display: inline-block; min-width: 66px; padding: 0 7px; border-radius: 3px; color: #fff;
  font-weight: 600; font-size: 12px; text-align: center; }
.badge.pass { background: #00704f; }
.badge.marginal { background: #8a5c00; }
.badge.fail { background: #b3261e; }
dl { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px 22px; margin: 10px 0; }
dt { font-size: 12px; color: #555; }
dd { margin: 0; overflow-wrap: anywhere; }
.dense dl { grid-template-columns: repeat(4, 1fr); gap: 6px 18px; font-size: 12.5px; }
.dense dt { font-size: 11px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; margin: 4px 0; }
th { font-size: 12px; font-weight: 600; color: #444; border-bottom: 1px solid #999; }
th, td { padding: 2px 8px; text-align: left; vertical-align: middle; }
td { border-bottom: 1px solid #e4e6e9; }
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
table.parameters th:nth-child(8) { width: 11%; }
table.parameters.plain { table-layout: auto; }
table.parameters svg { width: 100%; height: 16px; margin: 0; }
table.budget th, table.budget td { padding: 1px 4px; font-size: 12px; }
svg text { font: 12px system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; fill: #1a1a1a; }
svg text.tick { font-size: 11px; fill: #333; }
svg text.inside { font-size: 11px; font-weight: 600; fill: #fff; }
svg text.inside.dark { fill: #1a1a1a; }
svg .share { stroke: #fff; stroke-width: .6; }
svg .grid { stroke: #e1e4e8; }
svg .frame { fill: none; stroke: #888; }
svg .zero { stroke: #888; }
svg .level { stroke: #555; stroke-dasharray: 5 4; }
svg .allowed { fill: #dce9f3; stroke: #8fb3cf; }
svg .bar { stroke: #1a1a1a; stroke-width: 2; }
svg .mark { fill: #333; }
svg .mark.pass { fill: #00704f; }
svg .mark.marginal { fill: #b87a00; }
svg .mark.fail { fill: #b3261e; }
svg .lane { fill: #f1f2f4; }
svg .static { fill: #0a5c94; }
svg .turn { fill: #00805c; }
svg .rejected { fill: #c2491d; }
@media print {
  html, body { background: #fff; }
  body { max-width: none; margin: 0; padding: 0; box-shadow: none; font-size: 9.6pt; }
  h1 { font-size: 17pt; }
  .subtitle { margin: 0; }
  .outcome { margin: 8pt 0; padding: 6pt 10pt; }
  td { padding-top: 1px; padding-bottom: 1px; }
  table.parameters td { line-height: 1.25; }
  table.budget th, table.budget td { padding: 0 3px; font-size: 7.6pt; }
  .dense dl { font-size: 8pt; gap: 2pt 12pt; line-height: 1.3; }
  .dense dt { font-size: 7pt; }
  h2 { font-size: 12.5pt; margin-top: 16pt; break-after: avoid; }
  h3 { break-after: avoid; }
  svg, tr, .outcome, .whole, .dense, dl div { break-inside: avoid; }
  section.page { break-before: page; }
  .badge, .outcome, svg { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
@media (max-width: 700px) {
  body { margin: 0; padding: 18px; }
  dl, .dense dl { grid-template-columns: repeat(2, 1fr); }
  section { overflow-x: auto; }
  .budget svg { min-width: 620px; }
}
"""
