// One evaluation, live: how far it is, until it ends; then what it has brought.

import { html, useState } from "./vendor/preact-htm.js";
import { ask, of } from "./api.js";
import { useData, useEvents } from "./data.js";
import { called } from "./evaluations.js";
import { Await, Dialog, Facts, Form, league as at, notify, Outcome, Progress, Ref, sentence, State, Table, useTitle, When } from "./parts.js";
import { count, interval, number, percent, signed, tail } from "./words.js";

const GOES_ON = ["queued", "running"];
const hasEnded = (name, document) => name === "evaluation" && !GOES_ON.includes(document.state);

export function Evaluation({ league, evaluation, about }) {
  const path = of(league, "evaluations", evaluation);
  const first = useData(path);
  const [latest, setLatest] = useState(null);
  useEvents(first.data && GOES_ON.includes(first.data.state) ? `${path}/events` : null, (name, data) => name === "evaluation" && setLatest(data), hasEnded);
  const now = latest ?? first.data;
  useTitle(`Evaluation ${evaluation}`, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "evaluations")}>Evaluations</a></p>
    <div class="head"><h2 id="heading">Evaluation ${evaluation}</h2><span role="status">${now && html`<${State} of=${now.state} />`}</span>
      ${now && GOES_ON.includes(now.state) && html`<${Stop} path=${path} evaluation=${evaluation} stopped=${setLatest} />`}</div>
    <${Await} of=${first}>${now && html`<${About} of=${now} champion=${about.champion} />`}<//>
  </section>`;
}

function About({ of: now, champion }) {
  const { asked, progress } = now;
  return html`
    ${now.state === "queued" && html`<p class="soft">It waits for the studio to begin.</p>`}
    ${progress && html`<div class="live"><p class="what">${progress.what}</p><${Progress} played=${progress.played} of=${progress.of} what="Matches played" />
      ${progress.llr != null && html`<p class="soft">LLR ${number(progress.llr)}, between ${number(progress.bounds?.[0])} and ${number(progress.bounds?.[1])}</p>`}</div>`}
    ${now.error && html`<div class="notice bad" role="alert"><p><strong>It failed.</strong> ${sentence(now.error.message)}</p></div>`}
    <${Facts} of=${[
      ["What", called(asked)],
      asked.blocks != null && ["Blocks of each pair", count(asked.blocks)],
      asked.games != null && ["At most games", count(asked.games)],
      asked.minutes != null && ["At most minutes", count(asked.minutes)],
      asked.precision != null && ["Until ± Elo", count(asked.precision)],
      ["Asked by", html`<span class="words">${now.actor}</span> <small><${When} at=${now.created_at} /></small>`],
      now.ended_at && ["Ended", html`<${When} at=${now.ended_at} />${now.stopped_by && html` <small class="words">stopped by ${now.stopped_by}</small>`}`],
      now.reason && ["Reason", html`<span class="words">${now.reason}</span>`, "name"],
    ]} />
    ${asked.contestants?.length > 0 && html`<details><summary>Contestants</summary><p class="words">${asked.contestants.join(", ")}</p></details>`}
    ${now.result && html`<${Result} of=${now.result} champion=${champion} />`}`;
}

function Result({ of: result, champion }) {
  return html`
    ${result.verdicts?.length > 0 && html`<h3>Verdicts</h3><ul class="plainlist">${result.verdicts.map((each) => html`<li key=${each.verdict}>
      <a href=${at(result.league, "verdicts", each.verdict)}><span class="ref">${tail(each.candidate)}</span> against <span class="ref">${tail(each.opponent)}</span></a> <${Outcome} of=${each.outcome} /></li>`)}</ul>`}
    ${result.faults?.length > 0 && html`<div class="notice bad"><ul>${result.faults.map((fault) => html`<li>${fault}</li>`)}</ul></div>`}
    ${result.standings?.length > 0 && html`<h3>Standings</h3>
      <${Table} caption="Standings" head=${[["Contestant"], ["Rating", "number"], ["95 % interval"], ["Score", "number"], ["Games", "number"]]}>
        ${result.standings.map((row) => html`<tr key=${row.ref}><th scope="row"><${Ref} of=${row.ref} champion=${champion} /></th><td class="number strong">${signed(row.rating)}</td>
          <td class="nowrap soft">${interval(row.interval)}</td><td class="number">${percent(row.score)}</td><td class="number">${count(row.games)}</td></tr>`)}<//>`}
    ${result.cross_play && html`<${Together} of=${result.cross_play} />`}
    ${result.games != null && html`<p class="soft small">${count(result.games)} games, of which ${count(result.distinct_games)} are different. It ended by its ${result.stopped_by}.</p>`}`;
}

function Together({ of: { contestants, returns } }) {
  return html`<h3>Together</h3>
    <${Table} caption="Mean returns where the row's contestant plays one agent and the column's all others" hidden=${false} head=${[["", "", true], ...contestants.map((ref) => [tail(ref), "number"])]}>
      ${contestants.map((ref, row) => html`<tr key=${ref}><th scope="row"><span class="ref">${tail(ref)}</span></th>${returns[row].map((each) => html`<td class="number">${number(each?.value)}</td>`)}</tr>`)}<//>`;
}

function Stop({ path, evaluation, stopped }) {
  const [isAsked, setIsAsked] = useState(false);
  const close = () => setIsAsked(false);
  const submit = async () => {
    stopped(await ask(path, { method: "DELETE" }));
    notify(`Evaluation ${evaluation} stops.`);
    close();
  };
  return html`<button type="button" onClick=${() => setIsAsked(true)}>Stop …</button>
    ${isAsked && html`<${Dialog} title="Stop evaluation ${evaluation}" onClose=${close}>
      <${Form} submit=${submit} label="Stop it" tone="danger" onCancel=${close}><p>Games that were played count. Asked for again, it goes on behind them.</p><//>
    <//>`}`;
}
