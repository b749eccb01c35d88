// Training runs: how far each is, and its curves while it goes on.

import { html, useState } from "./vendor/preact-htm.js";
import { of } from "./api.js";
import { Chart, Numbers } from "./chart.js";
import { useData, useList, useMark } from "./data.js";
import { Await, Empty, Facts, league as at, More, State, Table, useTitle, When } from "./parts.js";
import { count, short } from "./words.js";

export function Runs({ league }) {
  const runs = useList(of(league, "runs"), "runs", useMark("run", "runs"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Training</h2></div>
    <${Await} of=${runs}>${runs.items && (runs.items.length
      ? html`<${Table} caption="Training runs, newest first" head=${[["Run"], ["State"], ["Algorithm"], ["Steps", "number"], ["How far"], ["Began"], ["Heard of"]]} cls="full">
          ${runs.items.map((run) => html`<tr key=${run.run}>
            <th scope="row"><a href=${at(league, "runs", run.run)}>${run.run}</a></th><td><${State} of=${run.state} /></td><td>${run.algorithm}</td>
            <td class="number">${short(run.steps)}</td><td><${Share} of=${run} /></td><td class="nowrap"><${When} at=${run.began_at} /></td><td class="nowrap"><${When} at=${run.heartbeat_at} /></td></tr>`)}<//>`
      : html`<${Empty}>No training was recorded yet. <code>league train</code> records its runs while they go on.<//>`)}<//>
    <${More} of=${runs} />
  </section>`;
}

/** Of its steps or its time, whichever ends it sooner. */
function Share({ of: run }) {
  const share = Math.min(1, Math.max(run.steps / run.target, run.minutes ? run.seconds / (60 * run.minutes) : 0));
  return html`<span class="progress"><progress max="1" value=${share} aria-label="How far ${run.run} is"></progress> <span class="soft">${Math.floor(100 * share)} %</span></span>`;
}

export function Run({ league, run }) {
  const found = useData(of(league, "runs", run), useMark("runs"));
  const about = found.data;
  useTitle(run, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "runs")}>Training</a></p>
    <${Await} of=${found}>${about && html`
      <div class="head"><h2 id="heading" class="words">${run}</h2><${State} of=${about.state} /></div>
      <${Facts} of=${[
        ["Steps", html`${count(about.steps)} <small>of ${count(about.target)}</small>`],
        about.minutes && ["Minutes", html`${count(Math.floor(about.seconds / 60))} <small>of ${about.minutes}</small>`],
        ["How far", html`<${Share} of=${about} />`],
        ["Algorithm", about.algorithm],
        ["Seed", count(about.seed)],
        ["Began", html`<${When} at=${about.began_at} date />`],
        ["Heard of", html`<${When} at=${about.heartbeat_at} />`],
        about.parent != null && ["Goes on from", html`<span class="ref">${league}@${about.parent}</span>`],
        about.ended_at && ["Ended", html`<${When} at=${about.ended_at} date />`],
        about.error && ["Failed", html`<span class="words">${about.error}</span>`, "name"],
      ]} />
      <${Curves} of=${about.points ?? []} />
      ${about.settings && Object.keys(about.settings).length > 0 && html`<details><summary>Settings</summary><pre>${JSON.stringify(about.settings, null, 2)}</pre></details>`}`}
    <//>
  </section>`;
}

/** One chart for each quantity, with a line for each policy; what is of single agents, and of the machine, on demand. */
function Curves({ of: points }) {
  const [wantsAll, setWantsAll] = useState(false);
  if (!points.length) return html`<${Empty}>There is no point of a curve yet: the first comes with the first result.<//>`;
  const x = points.map((point) => point.steps);
  const all = quantities(points);
  const main = all.filter((each) => !each.isDetail);
  return html`<div class="curves">${(wantsAll ? all : main).map((each) => html`<${Quantity} key=${each.name} of=${each} x=${x} />`)}</div>
    ${all.length > main.length && html`<p class="more"><button type="button" onClick=${() => setWantsAll(!wantsAll)}>${wantsAll ? "Fewer curves" : "More curves"}</button></p>`}`;
}

function Quantity({ of: { name, lines }, x }) {
  const ends = lines.map((line) => `${line.name}: ${short(line.values.findLast((value) => value != null))} at last`);
  return html`<article><h3>${name}</h3><${Chart} label="${name} over ${count(x.at(-1))} steps. ${ends.join("; ")}." x=${x} lines=${lines} xName="steps" height=${200} />
    <${Numbers} x=${x} lines=${lines} xName="steps" caption=${name} /></article>`;
}

/** [{name, isDetail, lines}] of points whose curves are `{"policy/quantity": number}`. */
function quantities(points) {
  const found = new Map();
  points.forEach((point, at) => {
    for (const [curve, value] of Object.entries(point.curves)) {
      const [name, line, isDetail] = named(curve);
      if (!found.has(name)) found.set(name, { name, isDetail, lines: new Map() });
      const { lines } = found.get(name);
      if (!lines.has(line)) lines.set(line, Array(points.length).fill(null));
      lines.get(line)[at] = value;
    }
  });
  return [...found.values()].map((each) => ({ ...each, lines: [...each.lines].map(([name, values]) => ({ name, values })) }));
}

/** A curve's quantity and line, and whether it is a detail: training/curves.py has their names. */
function named(curve) {
  const [first, ...rest] = curve.split("/");
  if (!rest.length) return [first, "all", false];
  if (first === "agents") return [`${rest.at(-1)} of each agent`, rest.slice(0, -1).join("/"), true];
  if (first === "time") return ["seconds of a report", rest.join("/"), true];
  return [rest.join("/"), first, first === "gpu"];
}
