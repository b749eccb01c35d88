// Training runs with their progress and learning curves.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { Chart, DataTable } from "./chart.js";
import { useChangeToken, useData, useList } from "./data.js";
import { Await, EmptyState, leaguePath, Properties, ShowMore, State, Table, Time, useTitle } from "./components.js";
import { isOpponentCurve, Opponents } from "./opponents.js";
import { Strength } from "./strength.js";
import { count, short, shortRef } from "./format.js";

export function Runs({ league }) {
  const runs = useList(apiPath(league, "runs"), "runs", useChangeToken("run", "runs"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Training</h2></div>
    <${Await} result=${runs}>${runs.items && (runs.items.length
      ? html`<${Table} caption="Training runs, newest first" head=${[["Run"], ["State"], ["Role"], ["Algorithm"], ["Steps", "number"], ["Progress"], ["Started"], ["Last heartbeat"]]} cls="full">
          ${runs.items.map((run) => html`<tr key=${run.run}>
            <th scope="row"><a href=${leaguePath(league, "training", run.run)}>${run.run}</a></th><td><${State} value=${run.state} /></td><td class="nowrap"><${Role} run=${run} /></td><td>${run.algorithm}</td>
            <td class="number">${short(run.steps)}</td><td><${RunProgress} run=${run} /></td><td class="nowrap"><${Time} at=${run.began_at} /></td><td class="nowrap"><${Time} at=${run.heartbeat_at} /></td></tr>`)}<//>`
      : html`<${EmptyState}>No training runs yet. Start one with <code>league train</code>.<//>`)}<//>
    <${ShowMore} list=${runs} />
  </section>`;
}

function Role({ run: { exploits } }) {
  return exploits ? html`exploiter of <span class="ref">${shortRef(exploits)}</span>` : "main";
}

/** The share of the step budget or of the time budget, whichever is larger. */
function RunProgress({ run }) {
  const share = Math.min(1, Math.max(run.target ? run.steps / run.target : 0, run.minutes ? run.seconds / (60 * run.minutes) : 0));
  return html`<span class="progress"><progress max="1" value=${share} aria-label="Progress of ${run.run}"></progress> <span class="muted">${Math.floor(100 * share)} %</span></span>`;
}

export function Run({ league, run }) {
  const found = useData(apiPath(league, "runs", run), useChangeToken("runs"));
  const about = found.data;
  useTitle(run, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${leaguePath(league, "training")}>Training</a></p>
    <${Await} result=${found}>${about && html`
      <div class="head"><h2 id="heading" class="wrap">${run}</h2><${State} value=${about.state} /></div>
      <${Properties} items=${[
        ["Steps", html`${count(about.steps)}${about.target != null && html` <small>of ${count(about.target)}</small>`}`],
        about.minutes && ["Minutes", html`${count(Math.floor(about.seconds / 60))} <small>of ${about.minutes}</small>`],
        ["Progress", html`<${RunProgress} run=${about} />`],
        ["Role", html`<${Role} run=${about} />`],
        ["Algorithm", about.algorithm],
        ["Seed", count(about.seed)],
        ["Started", html`<${Time} at=${about.began_at} date />`],
        ["Last heartbeat", html`<${Time} at=${about.heartbeat_at} />`],
        about.parent != null && ["Parent", html`<span class="ref">${league}@${about.parent}</span>`],
        about.ended_at && ["Ended", html`<${Time} at=${about.ended_at} date />`],
        about.error && ["Error", html`<span class="wrap">${about.error}</span>`, "name"],
      ]} />
      <${Strength} league=${league} rows=${about.strength ?? []} />
      <${Opponents} curves=${about.curves} points=${about.points ?? []} />
      <${Curves} points=${about.points ?? []} />
      ${about.settings && Object.keys(about.settings).length > 0 && html`<details><summary>Settings</summary><pre>${JSON.stringify(about.settings, null, 2)}</pre></details>`}`}
    <//>
  </section>`;
}

/** One chart per metric, with one line per policy or agent. Metrics of the machine are shown on demand. */
function Curves({ points }) {
  const [wantsAll, setWantsAll] = useState(false);
  if (!points.length) return html`<${EmptyState}>No metrics yet. They appear after the first training iteration.<//>`;
  const x = points.map((point) => point.steps);
  const all = metricsOf(points);
  const main = all.filter((each) => !each.isDetail);
  return html`<div class="curves">${(wantsAll ? all : main).map((each) => html`<${MetricChart} key=${each.name} metric=${each} x=${x} />`)}</div>
    ${all.length > main.length && html`<p class="more"><button type="button" onClick=${() => setWantsAll(!wantsAll)}>${wantsAll ? "Show fewer metrics" : "Show all metrics"}</button></p>`}`;
}

function MetricChart({ metric: { name, lines }, x }) {
  const values = lines.map((line) => `${line.name}: ${short(line.values.findLast((value) => value != null))}`);
  return html`<article><h3>${name}</h3><${Chart} label="${name} over ${count(x.at(-1))} steps. Latest values: ${values.join("; ")}." x=${x} lines=${lines} xName="steps" yName=${name} height=${200} />
    <${DataTable} x=${x} lines=${lines} xName="steps" caption=${name} /></article>`;
}

/** [{name, isDetail, lines}] of points whose curves are `{"policy/metric": number}`. */
function metricsOf(points) {
  const found = new Map();
  points.forEach((point, index) => {
    for (const [curve, value] of Object.entries(point.curves)) {
      if (isOpponentCurve(curve)) continue;
      const [name, line, isDetail] = parseName(curve);
      if (!found.has(name)) found.set(name, { name, isDetail, lines: new Map() });
      const { lines } = found.get(name);
      if (!lines.has(line)) lines.set(line, Array(points.length).fill(null));
      lines.get(line)[index] = value;
    }
  });
  return [...found.values()].map((each) => ({ ...each, lines: [...each.lines].map(([name, values]) => ({ name, values })) }));
}

/** [metric, line, isDetail] of a curve. The trainer defines the names. */
function parseName(curve) {
  const [first, ...rest] = curve.split("/");
  if (!rest.length) return [first, "all", false];
  if (first === "agents") return [`${rest.at(-1)} per agent`, rest.slice(0, -1).join("/"), false];
  if (first === "time") return ["seconds per iteration", rest.join("/"), true];
  return [rest.join("/"), first, first === "gpu"];
}
