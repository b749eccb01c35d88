// The list of leagues.

import { html } from "./vendor/preact-htm.js";
import { Await, Badge, EmptyState, leaguePath, Outcome, Time, useTitle } from "./components.js";
import { useData } from "./data.js";
import { count, plural, rate, shortRef } from "./format.js";

const REFRESH_INTERVAL = 5000;

export function Leagues() {
  useTitle("Leagues");
  const leagues = useData("/v1/leagues", "", REFRESH_INTERVAL);
  return html`<div class="title"><h1>Leagues</h1></div>
    <${Await} result=${leagues}>${leagues.data && html`<${List} leagues=${leagues.data.leagues} />`}<//>`;
}

function List({ leagues }) {
  if (!leagues.length) {
    return html`<${EmptyState}>No leagues yet. Create one with <code>league train connect_four</code>.<//>`;
  }
  return html`<table class="full stacked">
    <caption class="visually-hidden">Leagues</caption>
    <thead><tr>
      <th scope="col">League</th><th scope="col">Champion</th><th scope="col" class="number">Versions</th><th scope="col">Last verdict</th>
      <th scope="col" class="number">Games</th><th scope="col" class="number">Requests/s</th><th scope="col">Activity</th>
    </tr></thead>
    <tbody>${leagues.map((each) => html`<${Row} key=${each.league} row=${each} />`)}</tbody>
  </table>`;
}

function Row({ row }) {
  const { league, last_verdict: verdict } = row;
  return html`<tr>
    <th scope="row"><a class="ref" href=${leaguePath(league)}>${league}</a>${row.archived_at && html` <span class="muted small">archived</span>`}</th>
    <td data-label="Champion">${row.champion == null ? html`<span class="muted">none</span>` : html`<span class="ref">@${row.champion}</span>`}</td>
    <td class="number" data-label="Versions">${count(row.versions)}</td>
    <td data-label="Last verdict">${verdict ? html`<a class="plain-link" href=${leaguePath(league, "verdicts", verdict.verdict)}>
        <span class="ref">${shortRef(verdict.candidate)}</span> <${Outcome} value=${verdict.outcome} /></a> <span class="muted small"><${Time} at=${verdict.closed_at} /></span>`
      : html`<span class="muted">none</span>`}</td>
    <td class="number" data-label="Games">${count(row.games)}</td>
    <td class="number" data-label="Requests/s" title="${count(row.requests)} requests in total">${rate(row.requests_per_second)}</td>
    <td data-label="Activity"><${Activity} row=${row} /></td>
  </tr>`;
}

function Activity({ row: { league, running_evaluations: evaluations, running_runs: runs } }) {
  if (!evaluations && !runs) return html`<span class="muted">–</span>`;
  return html`${runs > 0 && html`<a class="plain-link" href=${leaguePath(league, "training")}><${Badge} tone="accent" sign="●">${plural(runs, "training run")}<//></a> `}
    ${evaluations > 0 && html`<a class="plain-link" href=${leaguePath(league, "evaluations")}><${Badge} tone="accent" sign="●">${plural(evaluations, "evaluation")}<//></a>`}`;
}
