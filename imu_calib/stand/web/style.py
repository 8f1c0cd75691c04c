"""The style of the page: light and dark, on a desktop and on a phone."""

STYLE = """
:root { --ground: #eef0f3; --card: #fff; --ink: #16191d; --soft: #59616b; --line: #d9dde2;
  --ok: #00704f; --warn: #8a5c00; --error: #b3261e; --mark: #0a5c94; --done: #b9d8c9; }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14171b; --card: #1e2329; --ink: #e9ecef; --soft: #a3acb6; --line: #39414a;
    --ok: #4cc79a; --warn: #e0b04a; --error: #ff8a80; --mark: #6cb8ec; --done: #27543f; }
}
* { box-sizing: border-box; }
body { background: var(--ground); color: var(--ink);
  font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; }
.nicegui-content { padding: 0; display: block; }
.stand { max-width: 1360px; margin: 0 auto; padding: 14px; display: grid; gap: 14px;
  grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); align-items: start; }
.stand > * { min-width: 0; width: 100%; }
.wide { grid-column: 1 / -1; }
.stand h1 { font-size: 17px; line-height: 1.3; margin: 0; font-weight: 600; }
.stand h2 { font-size: 24px; line-height: 1.25; margin: 0; font-weight: 600; }
.stand h3 { font-size: 14px; line-height: 1.3; margin: 8px 0 2px; font-weight: 600; }
.stand p { margin: 4px 0; }
.column { display: grid; gap: 14px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 12px 16px; }
.card > .title { font-size: 13px; font-weight: 600; color: var(--soft); margin: 0 0 6px; }
.small, .muted { color: var(--soft); font-size: 13px; }
.top { display: flex; flex-wrap: wrap; gap: 4px 18px; align-items: baseline; }
.banner, .notice { border-left: 8px solid var(--ok); background: var(--card); border-radius: 8px;
  padding: 14px 18px; border-top: 1px solid var(--line); border-bottom: 1px solid var(--line);
  border-right: 1px solid var(--line); }
.banner.warn { border-left-color: var(--warn); }
.banner.error, .notice { border-left-color: var(--error); }
body:not(.lost) .notice { display: none; }
/* What a stand did last is no news once it is not heard any more; a result stays one. */
.lost .banner:not([data-phase="done"], [data-phase="incomplete"], [data-phase="failed"])
  { display: none; }
.lost .control, .lost .q-dialog { display: none; }
.banner .split { display: flex; flex-wrap: wrap; gap: 10px 28px; justify-content: space-between; }
.banner .what { flex: 1 1 320px; min-width: 0; overflow-wrap: anywhere; }
.banner .time { flex: 0 0 auto; display: flex; flex-direction: column; min-width: 130px; }
.banner .time strong { font-size: 24px; line-height: 1.25; font-weight: 600;
  font-variant-numeric: tabular-nums; }
.detail { font-size: 16px; }
.bar { height: 8px; border-radius: 4px; background: var(--line); margin: 12px 0 4px;
  overflow: hidden; }
.bar div { height: 100%; background: var(--mark); }
.foot { display: flex; justify-content: space-between; font-variant-numeric: tabular-nums; }
.sign { display: inline-flex; align-items: center; justify-content: center; width: 1.35em;
  height: 1.35em; flex: none; border-radius: 50%; margin-right: .5em; color: var(--card);
  font-size: .8em; font-weight: 700; background: var(--ok); vertical-align: .08em; }
.sign.warn { background: var(--warn); }
.sign.error { background: var(--error); }
.sentences { list-style: none; margin: 0; padding: 0; }
.sentences li { display: flex; align-items: baseline; padding: 5px 0;
  border-top: 1px solid var(--line); }
.sentences li:first-child { border-top: 0; }
.sentences li > div { display: flex; flex-direction: column; min-width: 0;
  overflow-wrap: anywhere; }
.sentences b { font-size: 13px; color: var(--soft); font-weight: 600; }
.steps { list-style: none; display: flex; flex-wrap: wrap; gap: 4px; margin: 0 0 8px; padding: 0;
  }
.steps li { min-width: 28px; padding: 2px 4px; text-align: center; border-radius: 4px;
  font-size: 13px; font-variant-numeric: tabular-nums; border: 1px solid var(--line); }
.steps .done { background: var(--done); border-color: transparent; }
.steps .now { background: var(--mark); color: var(--card); border-color: transparent;
  font-weight: 700; }
.steps .again { border: 2px solid var(--warn); }
.stand dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(128px, 1fr));
  gap: 8px 14px;
  margin: 4px 0; }
.stand dt { font-size: 12.5px; color: var(--soft); }
.stand dd { margin: 0; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.stand dd span { color: var(--soft); font-size: 12.5px; margin-left: .5em; }
.stand .channels { grid-template-columns: repeat(3, minmax(0, 1fr));
  border-top: 1px solid var(--line);
  padding-top: 8px; }
.pair { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 4px 26px; }
.parameters { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums;
  font-size: 14px; }
.parameters th { font-size: 12px; font-weight: 600; color: var(--soft); text-align: left;
  border-bottom: 1px solid var(--soft); padding: 2px 5px; white-space: nowrap; }
.parameters td { padding: 1px 5px; border-bottom: 1px solid var(--line); white-space: nowrap; }
.parameters .r { text-align: right; }
.parameters .name { font-weight: 600; }
.parameters .course { width: 120px; }
.parameters td.course { padding: 0 5px; }
svg.course { display: block; width: 120px; height: 30px; }
.course .way { fill: none; stroke: var(--mark); stroke-width: 1.6; }
.course .now { fill: var(--mark); }
.course .predicted { stroke: var(--ok); stroke-dasharray: 4 3; }
.course .allowed { stroke: var(--error); stroke-width: 1.2; }
.units td { padding: 4px 5px; vertical-align: top; }
.units .state, .units .least { white-space: normal; overflow-wrap: anywhere; }
.units .least { padding-left: 22px; }
.units .name span { display: block; font-weight: 400; }
.units .looked-at { background: color-mix(in srgb, var(--mark) 14%, transparent); }
.chooser { max-width: 260px; margin-bottom: 8px; }
.key { display: flex; flex-wrap: wrap; gap: 2px 18px; font-size: 12.5px; color: var(--soft);
  margin-top: 8px; }
.key i { display: inline-block; width: 22px; height: 0; border-top: 2px solid var(--mark);
  vertical-align: .3em; margin-right: 6px; }
.key .predicted { border-top: 2px dashed var(--ok); }
.key .allowed { border-top: 2px solid var(--error); }
.badge { display: inline-block; margin-left: 6px; padding: 0 6px; border-radius: 3px;
  color: var(--card);
  font-weight: 600; font-size: 11.5px; background: var(--soft); }
.badge.pass { background: var(--ok); }
.badge.marginal { background: var(--warn); }
.badge.fail { background: var(--error); }
.plot .panels { display: grid; gap: 10px 24px; max-width: 1100px;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 320px), 1fr)); }
summary.title { cursor: pointer; }
details[open] > .title { margin-bottom: 8px; }
.plot svg { width: 100%; height: auto; display: block; }
.plot text { font: 12px system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif;
  fill: var(--ink); }
.plot text.tick { font-size: 11px; fill: var(--soft); }
.plot .grid { stroke: var(--line); }
.plot .frame { fill: none; stroke: var(--soft); }
.report .button { display: inline-block; padding: 6px 16px; border-radius: 6px;
  background: var(--mark);
  color: var(--card); text-decoration: none; font-weight: 600; }
.report iframe { width: 100%; height: 640px; border: 1px solid var(--line); border-radius: 6px;
  margin-top: 10px; background: #fff; display: block; }
.controls { display: flex; flex-wrap: wrap; gap: 8px; align-items: center; }
.nicegui-scene { width: 100%; border-radius: 6px; overflow: hidden; }
@media (max-width: 1080px) { .pair { grid-template-columns: minmax(0, 1fr); } }
@media (max-width: 760px) {
  .stand { grid-template-columns: minmax(0, 1fr); padding: 8px; gap: 10px; }
  .card, .banner, .notice { padding: 10px 12px; }
  .stand h2 { font-size: 20px; }
  .parameters { font-size: 13px; }
  /* The verdict stays; the limit itself is in the report. */
  .parameters .amount { display: none; }
  .parameters .badge { margin-left: 0; padding: 0 3px; font-size: 11px; }
  .units thead { display: none; }
  .units tr { display: grid; grid-template-columns: repeat(3, auto); justify-content: start;
    column-gap: 14px; border-bottom: 1px solid var(--line); padding: 4px 0; }
  .units .name { grid-column: 1 / -1; }
  .units td.r { text-align: left; }
  .units td.r::before { content: attr(data-label) " "; color: var(--soft); }
  .units td { border-bottom: 0; }
  .units .least { padding-left: 3px; }
  .units .state, .units .least { grid-column: 1 / -1; }
  .parameters td, .parameters th { padding-left: 3px; padding-right: 3px; }
  .parameters .course { width: 84px; }
  svg.course { width: 78px; height: 26px; }
  .stand .channels dd span { display: block; margin-left: 0; }
  .report iframe { display: none; }
}
@media (max-width: 480px) {
  .parameters { font-size: 12px; }
  .parameters .course { width: 44px; }
  svg.course { width: 42px; height: 24px; }
  .parameters td, .parameters th { padding-left: 1px; padding-right: 1px; }
  .parameters .unit { padding-left: 4px; }
  .parameters td.course { padding-left: 1px; padding-right: 1px; }
  .parameters .badge { font-size: 10px; padding: 0 2px; }
}
@media print {
  .stand, .stand * { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  .stand .channels dd span { display: block; margin-left: 0; }
  .card, .banner, .notice, tr { break-inside: avoid; }
}
"""
