// Training runs: how far each is, and its curves while it goes on.

import { html } from "./vendor/preact-htm.js";
import { of } from "./api.js";
import { Chart, Numbers } from "./chart.js";
import { useData, useList, useMark } from "./data.js";
import { Await, Empty, Facts, league as at, More, State, Table, useTitle, When } from "./parts.js";
import { count, short } from "./words.js";

export function Runs({ league }) {
  const runs = useList(of(league, "runs"), "runs", useMark("runs"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Training</h2></div>
    <${Await} of=${runs}>${runs.items && (runs.items.length
      ? html`<${Table} caption="Training runs, newest first" head=${[["Run"], ["State"], ["Algorithm"], ["Steps", "number"], ["How far"], ["Began"], ["Heard of"]]} cls="full">
          ${runs.items.map((run) => html`<tr key=${run.run}>
            <th scope="row"><a href=${at(league, "runs", run.run)}>${run.name}</a></th><td><${State} of=${run.state} /></td><td>${run.algorithm}</td>
            <td class="number">${short(run.steps)}</td><td><${Share} of=${run} /></td><td class="nowrap"><${When} at=${run.started_at} /></td><td class="nowrap"><${When} at=${run.heartbeat_at} /></td></tr>`)}<//>`
      : html`<${Empty}>No training was recorded yet. <code>league train</code> records its runs while they go on.<//>`)}<//>
    <${More} of=${runs} />
  </section>`;
}

function Share({ of: run }) {
  if (!run.target_steps) return html`<span class="soft">–</span>`;
  const share = Math.min(1, (run.steps ?? 0) / run.target_steps);
  return html`<span class="progress"><progress max="1" value=${share} aria-label="Steps of ${run.name}"></progress> <span class="soft">${Math.floor(100 * share)} %</span></span>`;
}

export function Run({ league, run }) {
  const found = useData(of(league, "runs", run), useMark("runs"));
  const about = found.data;
  useTitle(about?.name ?? "Training", league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "runs")}>Training</a></p>
    <${Await} of=${found}>${about && html`
      <div class="head"><h2 id="heading" class="words">${about.name}</h2><${State} of=${about.state} /></div>
      <${Facts} of=${[
        ["Steps", html`${count(about.steps)}${about.target_steps ? html` <small>of ${count(about.target_steps)}</small>` : ""}`],
        ["How far", html`<${Share} of=${about} />`],
        ["Algorithm", about.algorithm],
        ["Seed", count(about.seed)],
        ["Began", html`<${When} at=${about.started_at} date />`],
        ["Heard of", html`<${When} at=${about.heartbeat_at} />`],
        about.resumed_from && ["Goes on from", html`<span class="words">${about.resumed_from}</span>`, "name"],
        about.error && ["Failed", html`<span class="words">${about.error}</span>`, "name"],
      ]} />
      <${Curves} of=${about.points ?? []} />
      ${about.settings && Object.keys(about.settings).length > 0 && html`<details><summary>Settings</summary><pre>${JSON.stringify(about.settings, null, 2)}</pre></details>`}`}
    <//>
  </section>`;
}

/** One chart for each quantity, with a line for each policy. */
function Curves({ of: points }) {
  if (!points.length) return html`<${Empty}>There is no point of a curve yet: the first comes with the first result.<//>`;
  const x = points.map((point) => point.steps);
  return html`<div class="curves">${quantities(points).map(([name, lines]) => {
    const label = `${name} over ${count(x.at(-1))} steps. ${lines.map((line) => `${line.name}: ${short(line.values.findLast((value) => value != null))} at last`).join("; ")}.`;
    return html`<article key=${name}><h3>${name}</h3><${Chart} label=${label} x=${x} lines=${lines} xName="steps" height=${200} />
      <${Numbers} x=${x} lines=${lines} xName="steps" caption=${name} /></article>`;
  })}</div>`;
}

/** [quantity, lines] pairs: `{policy: {quantity: number}}`, or `{"policy/quantity": number}`, of each point. */
function quantities(points) {
  const found = new Map();
  points.forEach((point, at) => {
    for (const [name, policy, value] of Object.entries(point.curves).flatMap(named)) {
      if (!found.has(name)) found.set(name, new Map());
      const lines = found.get(name);
      if (!lines.has(policy)) lines.set(policy, Array(points.length).fill(null));
      lines.get(policy)[at] = value;
    }
  });
  return [...found].map(([name, lines]) => [name, [...lines].map(([line, values]) => ({ name: line, values }))]);
}

function named([name, value]) {
  if (value !== null && typeof value === "object") return Object.entries(value).map(([quantity, number]) => [quantity, name, number]);
  const cut = name.indexOf("/");
  return cut < 0 ? [[name, name, value]] : [[name.slice(cut + 1), name.slice(0, cut), value]];
}
