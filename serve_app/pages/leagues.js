// All leagues of the server.

import { html } from "./vendor/preact-htm.js";
import { Await, Badge, Empty, Outcome, useTitle, When, league as at } from "./parts.js";
import { useData, useTicks } from "./data.js";
import { count, rate, several, tail } from "./words.js";

const EVERY = 5000;

export function Leagues() {
  useTitle("Leagues");
  const leagues = useData("/v1/leagues", useTicks(EVERY));
  return html`<div class="title"><h1>Leagues</h1></div>
    <${Await} of=${leagues}>${leagues.data && html`<${List} of=${leagues.data.leagues} />`}<//>`;
}

function List({ of }) {
  if (!of.length) {
    return html`<${Empty}>There is no league yet. <code>league train configs/connect_four.yaml</code> makes one.<//>`;
  }
  return html`<table class="full stacked">
    <caption class="unseen">Leagues</caption>
    <thead><tr>
      <th scope="col">League</th><th scope="col">Champion</th><th scope="col" class="number">Versions</th><th scope="col">Last verdict</th>
      <th scope="col" class="number">Games</th><th scope="col" class="number">Requests/s</th><th scope="col">Now</th>
    </tr></thead>
    <tbody>${of.map((each) => html`<${Row} key=${each.league} of=${each} />`)}</tbody>
  </table>`;
}

function Row({ of: each }) {
  const { league, last_verdict: verdict } = each;
  return html`<tr>
    <th scope="row"><a href=${at(league)}>${league}</a></th>
    <td data-label="Champion">${each.champion == null ? html`<span class="soft">none yet</span>` : html`<span class="ref">@${each.champion}</span>`}</td>
    <td class="number" data-label="Versions">${count(each.versions)}</td>
    <td data-label="Last verdict">${verdict ? html`<a class="plainly" href=${at(league, "verdicts", verdict.verdict)}>
        <span class="ref">${tail(verdict.candidate)}</span> <${Outcome} of=${verdict.outcome} /></a> <span class="soft small"><${When} at=${verdict.closed_at} /></span>`
      : html`<span class="soft">none yet</span>`}</td>
    <td class="number" data-label="Games">${count(each.games)}</td>
    <td class="number" data-label="Requests/s" title="${count(each.requests)} requests in all">${rate(each.requests_per_second)}</td>
    <td data-label="Now"><${Now} of=${each} /></td>
  </tr>`;
}

function Now({ of: each }) {
  const evaluations = each.running_evaluations;
  const runs = each.running_runs;
  if (!evaluations && !runs) return html`<span class="soft">–</span>`;
  return html`${runs > 0 && html`<a class="plainly" href=${at(each.league, "runs")}><${Badge} tone="accent" sign="●">${several(runs, "training")}<//></a> `}
    ${evaluations > 0 && html`<a class="plainly" href=${at(each.league, "evaluations")}><${Badge} tone="accent" sign="●">${several(evaluations, "evaluation")}<//></a>`}`;
}
