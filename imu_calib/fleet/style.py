"""Additions of the page on a catalogue to the report's style: a wide table, controls, drawings."""

FLEET_STYLE = """
:root { --stand-4: #a0559a; --stand-5: #7a6a00; --stand-6: #3b7fd1; --stand-7: #8a5a3c;
  --stand-8: #5b6670; --good-area: #4f9d82; }
@media screen and (prefers-color-scheme: dark) { :root { --bad: #ff7a6e; --stand-4: #d58ad0;
  --stand-5: #cbb73c; --stand-6: #86b4f4; --stand-7: #cf9a78; --stand-8: #a7b2bd;
  --good-area: #2f8f70; }
  .badge.fail { background: #c4352b; }
  .outcome.fail { border-color: #c4352b; } }
body { max-width: 1180px; }
[hidden] { display: none !important; }
a { color: var(--title); }
h1, h2 { scroll-margin-top: 8px; }
.badge { min-width: 0; white-space: nowrap; font-size: 11.5px; padding: 0 6px; }
.badge.plain { background: #5b6670; }
.badges .badge { margin: 1px 3px 1px 0; }
.matter { margin: 14px 0 18px; padding-left: 14px; border-left: 4px solid var(--faint); }
.matter.fail { border-color: var(--bad); }
.matter.marginal { border-color: var(--mark-doubt); }
.matter h3 { margin-top: 0; font-size: 15px; }
table.cases td, table.cases th { font-size: 13px; vertical-align: top; }
table.cases td { overflow-wrap: anywhere; }
table.cases td:first-child { min-width: 110px; }
.controls { display: flex; flex-wrap: wrap; gap: 8px 16px; align-items: center; margin: 8px 0; }
.controls label { display: inline-flex; min-width: 0; max-width: 100%; gap: 6px;
  align-items: center; font-size: 13px; color: var(--soft); }
input, select, button { font: inherit; font-size: 13px; color: var(--ink); background: var(--panel);
  border: 1px solid var(--frame); border-radius: 4px; padding: 4px 9px; max-width: 100%; }
button { cursor: pointer; }
button:disabled { opacity: .45; cursor: default; }
:focus-visible { outline: 2px solid var(--static); outline-offset: 1px; }
#unit:focus { outline: none; }
button.choose { padding: 0 6px; font-weight: 600; min-width: 58px; text-align: left; }
button.choose[aria-pressed="true"] { background: #0a5c94; border-color: #0a5c94;
  color: #fff; }
table.units th button { border: 0; background: none; padding: 2px 0; font-weight: 600;
  font-size: 12px; color: var(--soft); white-space: nowrap; }
table.units .arrow { display: inline-block; width: 1.1em; text-align: left; padding-left: 3px; }
table.units td { font-size: 13px; }
table.units td.of-sessions, table.units td.of-failed { text-align: right; padding-right: 22px; }
table.units td.of-newest, table.units td.of-due { white-space: nowrap; }
table.units td.of-unit, table.units td.of-stand { overflow-wrap: anywhere; }
table.units td.of-unit { min-width: 64px; }
.day { white-space: nowrap; }
table.units small, #unit-name small { color: var(--faint); font-weight: 400; }
.bar { display: flex; justify-content: space-between; align-items: center; gap: 14px;
  border-bottom: 2px solid var(--title); margin: 30px 0 10px; }
.bar h2 { border: 0; margin: 0; overflow-wrap: anywhere; }
#unit { scroll-margin-top: 6px; }
.plot { margin: 6px 0; overflow: hidden; }
.plot h4 { margin: 8px 0 0; font-size: 13px; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 14px; margin: 2px 0; font-size: 12px;
  color: var(--soft); }
.legend span { overflow-wrap: anywhere; }
.legend span::before { content: ""; display: inline-block; width: 9px; height: 9px;
  margin-right: 5px; border-radius: 50%; background: var(--tone); }
table.of-unit td, table.recordings td, table.population td { font-size: 13px; }
table.of-unit td:nth-child(2), table.of-unit td:nth-child(3), table.of-unit td:nth-child(5),
table.of-unit td:nth-child(6), table.of-unit td:nth-child(7) { text-align: right;
  white-space: nowrap; }
table.of-unit th:nth-child(2), table.of-unit th:nth-child(3), table.of-unit th:nth-child(5),
table.of-unit th:nth-child(6), table.of-unit th:nth-child(7) { text-align: right; }
table.recordings td { overflow-wrap: anywhere; vertical-align: top; white-space: pre-line; }
table.recordings td:first-child { white-space: nowrap; }
table.population svg { width: 120px; height: 18px; margin: 0; }
svg .within { fill: var(--allowed); }
svg .count { fill: var(--static); }
@media screen and (max-width: 700px) {
  .matter { padding-left: 10px; }
  .wide > table.population, .wide > table.of-unit { min-width: 620px; }
  .wide > table.recordings { min-width: 700px; }
  .wide > table.recordings td { white-space: pre-line; }
  .controls label { flex: 1 1 100%; justify-content: space-between; }
  .controls label input, .controls label select { flex: 0 1 72%; min-width: 0; padding: 8px 9px; }
  .controls button { padding: 8px 14px; }
  table.units, table.units tbody { display: block; }
  table.units thead tr { display: flex; flex-wrap: wrap; gap: 2px 14px; padding-bottom: 4px;
    border-bottom: 1px solid var(--rule); }
  table.units thead th { border: 0; padding: 3px 0; }
  table.units tbody tr { display: grid; grid-template-columns: 1fr 1fr; gap: 0 10px;
    padding: 7px 0; border-bottom: 1px solid var(--hair); }
  table.units td, .wide > table.units td { border: 0; padding: 0; white-space: normal;
    text-align: left; overflow-wrap: anywhere; }
  table.units td.of-status, table.units td.of-unit { grid-column: 1 / 3; }
  table.units td.of-unit { font-size: 14.5px; font-weight: 600; }
  table.units td.of-status { order: 2; margin-top: 3px; }
  table.units td:not(.of-unit, .of-status)::before { content: attr(data-name) " ";
    color: var(--faint); font-size: 12px; }
  table.units td:empty { display: none; }
}
@media print {
  .screen, .controls, #close, button.show { display: none; }
  .matter { margin: 6pt 0 8pt; padding-left: 8pt; }
  table.cases td, table.cases th, table.units td, table.units th button { font-size: 7.6pt;
    padding: 0 4px; }
  table.units td, table.units th { padding: 0 4px; }
  table.units thead, table.cases thead { display: table-header-group; }
  table.units th button, .choose { background: none; border: 0; padding: 0; }
  table.units .badge { font-size: 6.8pt; padding: 0 3px; }
  button.choose[aria-pressed="true"] { background: none; color: inherit; }
  /* Drawn for a window of up to 1088 px: 184 mm are 695. */
  .plot { zoom: .63; break-inside: avoid; }
  .legend span::before { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  a { color: inherit; text-decoration: none; }
  .matter h3 { break-after: avoid; }
}
"""
