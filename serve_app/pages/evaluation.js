// One evaluation: live progress, and the result when it is done.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { useData, useEvents } from "./data.js";
import { typeOf } from "./evaluations.js";
import { Await, Dialog, Form, leaguePath, notify, Outcome, Progress, Properties, Ref, sentence, State, Table, Time, useTitle } from "./components.js";
import { count, interval, number, percent, shortRef, signed } from "./format.js";

const ACTIVE = ["queued", "running"];
const isLast = (name, data) => name === "evaluation" && !ACTIVE.includes(data.state);

export function Evaluation({ league, evaluation, about }) {
  const path = apiPath(league, "evaluations", evaluation);
  const initial = useData(path);
  const [latest, setLatest] = useState(null);
  useEvents(initial.data && ACTIVE.includes(initial.data.state) ? `${path}/events` : null, (name, data) => name === "evaluation" && setLatest(data), isLast);
  const current = latest ?? initial.data;
  useTitle(`Evaluation ${evaluation}`, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${leaguePath(league, "evaluations")}>Evaluations</a></p>
    <div class="head"><h2 id="heading">Evaluation ${evaluation}</h2><span role="status">${current && html`<${State} value=${current.state} />`}</span>
      ${current && ACTIVE.includes(current.state) && html`<${Stop} path=${path} evaluation=${evaluation} stopped=${(reply) => setLatest((now) => (now && !ACTIVE.includes(now.state) ? now : reply))} />`}</div>
    <${Await} result=${initial}>${current && html`<${Details} evaluation=${current} champion=${about.champion} />`}<//>
  </section>`;
}

function Details({ evaluation: current, champion }) {
  const { request: requested, progress } = current;
  return html`
    ${current.state === "queued" && html`<p class="muted">Waiting for the evaluation service.</p>`}
    ${progress && html`<div class="live"><p class="what">${progress.what}</p><${Progress} played=${progress.played} of=${progress.of} label="Matches played" />
      ${progress.llr != null && html`<p class="muted">LLR ${number(progress.llr)}, decision bounds ${number(progress.bounds?.[0])} and ${number(progress.bounds?.[1])}</p>`}</div>`}
    ${current.error && html`<div class="notice bad" role="alert"><p><strong>The evaluation failed.</strong> ${sentence(current.error.message)}</p></div>`}
    <${Properties} items=${[
      ["Type", typeOf(requested)],
      requested.blocks != null && ["Blocks per pair", count(requested.blocks)],
      requested.games != null && ["Maximum games", count(requested.games)],
      requested.minutes != null && ["Maximum minutes", count(requested.minutes)],
      requested.precision != null && ["Precision, ± Elo", count(requested.precision)],
      ["Started by", html`<span class="wrap">${current.actor}</span> <small><${Time} at=${current.created_at} /></small>`],
      current.ended_at && ["Ended", html`<${Time} at=${current.ended_at} />${current.stopped_by && html` <small class="wrap">stopped by ${current.stopped_by}</small>`}`],
      current.reason && ["Reason", html`<span class="wrap">${current.reason}</span>`, "name"],
    ]} />
    ${requested.contestants?.length > 0 && html`<details><summary>Contestants</summary><p class="wrap">${requested.contestants.join(", ")}</p></details>`}
    ${current.result && html`<${Result} result=${current.result} champion=${champion} />`}`;
}

function Result({ result, champion }) {
  return html`
    ${result.verdicts?.length > 0 && html`<h3>Verdicts</h3><ul class="plain-list">${result.verdicts.map((each) => html`<li key=${each.verdict}>
      <a href=${leaguePath(result.league, "verdicts", each.verdict)}><span class="ref">${shortRef(each.candidate)}</span> against <span class="ref">${shortRef(each.opponent)}</span></a> <${Outcome} value=${each.outcome} /></li>`)}</ul>`}
    ${result.faults?.length > 0 && html`<div class="notice bad"><ul>${result.faults.map((fault) => html`<li>${fault}</li>`)}</ul></div>`}
    ${result.leaderboard?.length > 0 && html`<h3>Leaderboard</h3>
      <${Table} caption="Leaderboard" head=${[["Contestant"], ["Rating", "number"], ["95 % interval"], ["Score", "number"], ["Games", "number"]]}>
        ${result.leaderboard.map((row) => html`<tr key=${row.ref}><th scope="row"><${Ref} value=${row.ref} champion=${champion} /></th><td class="number strong">${signed(row.rating)}</td>
          <td class="nowrap muted">${interval(row.interval)}</td><td class="number">${percent(row.score)}</td><td class="number">${count(row.games)}</td></tr>`)}<//>`}
    ${result.cross_play && html`<${CrossPlay} matrix=${result.cross_play} />`}
    ${result.games != null && html`<p class="muted small">${count(result.games)} games, ${count(result.unique_games)} unique. Stopped by: ${result.stopped_by}.</p>`}`;
}

function CrossPlay({ matrix: { contestants, returns } }) {
  return html`<h3>Cross-play</h3>
    <${Table} caption="Mean return of a team in which the row plays one agent and the column plays all others" showCaption head=${[["", "", true], ...contestants.map((ref) => [shortRef(ref), "number"])]}>
      ${contestants.map((ref, row) => html`<tr key=${ref}><th scope="row"><span class="ref">${shortRef(ref)}</span></th>${returns[row].map((each) => html`<td class="number">${number(each?.value)}</td>`)}</tr>`)}<//>`;
}

function Stop({ path, evaluation, stopped }) {
  const [isOpen, setIsOpen] = useState(false);
  const close = () => setIsOpen(false);
  const submit = async () => {
    stopped(await request(path, { method: "DELETE" }));
    notify(`Stopping evaluation ${evaluation}.`);
    close();
  };
  return html`<button type="button" onClick=${() => setIsOpen(true)}>Stop …</button>
    ${isOpen && html`<${Dialog} title="Stop evaluation ${evaluation}" onClose=${close}>
      <${Form} submit=${submit} label="Stop" tone="danger" onCancel=${close}><p>Completed games are kept and count for ratings. If you start the same evaluation again, it continues after them.</p><//>
    <//>`}`;
}
