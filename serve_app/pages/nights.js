// Nights of training, with the strength and the learned exploitability of the champion after each, and nightly runs.

import { html } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { Chart } from "./chart.js";
import { useChangeToken, useList } from "./data.js";
import { Await, EmptyState, leaguePath, LongText, Outcome, ShowMore, Table, Time } from "./components.js";
import { Term } from "./term.js";
import { range } from "./strength.js";
import { interval, number, percent, shortRef, signed } from "./format.js";

export function Nights({ league }) {
  const nights = useList(apiPath(league, "training-nights"), "training_nights", useChangeToken("runs", "computed_at", "aliases"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Nights of training</h2></div>
    <${Await} result=${nights}>${nights.items && (nights.items.length
      ? html`<${Charts} nights=${nights.items.toReversed()} /><${List} league=${league} nights=${nights.items} />`
      : html`<${EmptyState}>No nights of training yet. Start one with <code>league nightly ${league} --train</code>.<//>`)}<//>
    <${ShowMore} list=${nights} />
    <${NightlyRuns} league=${league} />
  </section>`;
}

/** The runs of `league nightly`, alone or in a night of training. */
function NightlyRuns({ league }) {
  const runs = useList(apiPath(league, "nightly-runs"), "nightly_runs", useChangeToken("verdicts", "computed_at", "aliases"));
  return html`<h2>Nightly runs</h2>
    <${Await} result=${runs}>${runs.items && (runs.items.length
      ? html`<${Table} caption="Nightly runs, newest first" head=${[["Started"], ["Ended"], ["Candidates"], ["Verdicts"], ["Champion"], ["Errors"]]} cls="full">
          ${runs.items.map((run) => html`<${NightlyRun} key=${run.nightly_run} league=${league} run=${run} />`)}<//>`
      : html`<${EmptyState}>No nightly runs yet. Start one with <code>league nightly ${league}</code>.<//>`)}<//>
    <${ShowMore} list=${runs} />`;
}

function NightlyRun({ league, run: { candidates, verdicts, champion, champion_before: before, errors, began_at: began, ended_at: ended } }) {
  return html`<tr>
    <td class="nowrap"><${Time} at=${began} date /></td>
    <td class="nowrap">${ended ? html`<${Time} at=${ended} date />` : html`<span class="muted">not complete</span>`}</td>
    <td>${candidates.map(shortRef).join(", ") || html`<span class="muted">none</span>`}</td>
    <td>${verdicts.map((each) => html`<a key=${each.verdict} class="plain-link" href=${leaguePath(league, "verdicts", each.verdict)}><span class="ref">${shortRef(each.candidate)}</span> <${Outcome} value=${each.outcome} /></a> `)}</td>
    <td class="nowrap">${champion ? html`<span class="ref">${shortRef(champion)}</span>${champion !== before && html` <small>new</small>`}` : html`<span class="muted">–</span>`}</td>
    <td class="wrap"><${LongText}>${errors.join("; ")}<//></td>
  </tr>`;
}

function Charts({ nights }) {
  const rated = nights.filter((night) => night.rating != null);
  const measured = nights.filter((night) => night.exploitability);
  const last = { rated: rated.at(-1), measured: measured.at(-1)?.exploitability };
  return html`<div class="curves">
    ${rated.length > 0 && html`<article><h3>Strength</h3>
      <${Chart} label="Ratings of the champions of ${rated.length} nights. Last: ${last.rated.champion} with ${signed(last.rated.rating)} Elo." xName="night" yName="Elo"
        x=${rated.map((night) => night.number)} lines=${[{ name: "rating of the champion", values: rated.map((night) => night.rating), dots: true }]}
        intervals=${rated.map((night) => night.interval)} format=${(value) => signed(value)} />
      <p class="muted small">Current rating of the champion after each night, with 95 % intervals.</p></article>`}
    ${measured.length > 0 && html`<article><h3>Learned exploitability</h3>
      <${Chart} label="Scores of exploiters in ${measured.length} nights. Last: ${percent(last.measured.score)}, 95 % interval ${range(last.measured)}." xName="night" yName="score"
        x=${measured.map((night) => night.number)} lines=${[{ name: "score of the exploiter", values: measured.map((night) => night.exploitability.score), dots: true }]}
        intervals=${measured.map(({ exploitability: { low, high } }) => [low, high])} thresholds=${[{ name: "even", value: 0.5, tone: "muted" }]} format=${(share) => percent(share)} />
      <p class="muted small">The score of the best exploiter against the champion, with its interval. A best response scores at least the lower end. The return gain is its mean return minus that of the champion.</p></article>`}
  </div>`;
}

function List({ league, nights }) {
  const head = [["Night", "number"], ["Started"], ["Versions"], ["Champion"], [html`<${Term} name="rating">Rating<//>`, "number"], ["95 % interval"], ["Exploiter's score", "number"], ["Return gain", "number"], ["Errors"]];
  return html`<${Table} caption="Nights, newest first" head=${head} cls="full">${nights.map((night) => html`<${Row} key=${night.training_night} league=${league} night=${night} />`)}<//>`;
}

function Row({ league, night: { number: place, run, exploiter_run: exploiterRun, parent, versions, champion, champion_before: before, rating, interval: bounds, exploitability, errors, began_at: began, ended_at: ended } }) {
  const score = exploitability && html`${percent(exploitability.score)} <small class="muted">${range(exploitability)}</small>`;
  return html`<tr>
    <th scope="row" class="number">${place}</th>
    <td class="nowrap"><${Time} at=${began} date />${!ended && html` <small class="muted">not complete</small>`}</td>
    <td><a href=${leaguePath(league, "training", run)}>${versions.map(shortRef).join(", ") || "none"}</a>${versions.length > 0 && html` <small class="muted">from ${parent == null ? "scratch" : shortRef(parent)}</small>`}</td>
    <td class="nowrap">${champion ? html`<span class="ref">${shortRef(champion)}</span>${champion !== before && html` <small>new</small>`}` : html`<span class="muted">–</span>`}</td>
    <td class="number strong">${signed(rating)}</td><td class="nowrap muted">${interval(bounds)}</td>
    <td class="number nowrap">${score && exploiterRun ? html`<a href=${leaguePath(league, "training", exploiterRun)}>${score}</a>` : score ?? html`<span class="muted">–</span>`}</td>
    <td class="number nowrap">${exploitability?.gain ? html`${signed(exploitability.gain.mean, 2)} <small class="muted">${number(exploitability.gain.low)} to ${number(exploitability.gain.high)}</small>` : html`<span class="muted">–</span>`}</td>
    <td class="wrap"><${LongText}>${errors.join("; ")}<//></td>
  </tr>`;
}
