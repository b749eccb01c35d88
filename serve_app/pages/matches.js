// The matches of a league, or of one pair, newest first.

import { html } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { hasOneSide, useChangeToken, useList } from "./data.js";
import { Await, Badge, EmptyState, leaguePath, ShowMore, Table, Time, useTitle } from "./components.js";
import { useAddress } from "./router.js";
import { number, shortRef } from "./format.js";

export function Matches({ league, about }) {
  const { parameters } = useAddress();
  const [first, second] = [parameters.get("first"), parameters.get("second")];
  const matches = useList(query(apiPath(league, "matches"), { first, second }), "matches", useChangeToken("computed_at"));
  const isPair = first && second;
  const isTeam = hasOneSide(about);
  const relation = isTeam ? "and" : "against";
  useTitle(isPair ? `${shortRef(first)} ${relation} ${shortRef(second)}` : "Matches", league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${leaguePath(league, "payoff")}>Payoff matrix</a></p>
    <div class="head"><h2 id="heading">${isPair ? html`<span class="ref">${first}</span> ${relation} <span class="ref">${second}</span>` : "Matches"}</h2>
      ${isPair && html`<a href=${leaguePath(league, "matches")}>All matches</a>`}</div>
    <p class="muted">A match is a block of two games from the same seed and opening. ${isTeam
      ? "Each contestant plays one of them, as the whole team, and the returns are compared." : "The contestants swap sides."}</p>
    <${Await} result=${matches}>${matches.items && (matches.items.length
      ? html`<${Table} caption="Matches, newest first" head=${[["Match"], ["Contestants"], ["Scores"], ["Kind"], ["Played"]]} cls="full">
          ${matches.items.map((each) => html`<${Row} key=${each.match} league=${league} match=${each} />`)}<//>`
      : html`<${EmptyState}>${isPair ? "No matches between these contestants." : "No matches yet."}<//>`)}<//>
    <${ShowMore} list=${matches} />
  </section>`;
}

function Row({ league, match }) {
  return html`<tr>
    <th scope="row"><a href=${leaguePath(league, "matches", match.schedule, match.position)} aria-label="Match ${match.position} of ${match.schedule}">#${match.position}</a></th>
    <td>${match.contestants.map((ref, index) => html`${index > 0 && html`<span class="muted"> · </span>`}<span class="ref">${shortRef(ref)}</span>`)}</td>
    <td class="nowrap">${match.scores.map((score) => number(score, 1)).join(" : ")}</td>
    <td class="nowrap">${match.kind}${!match.counts && html` <${Badge} sign="∅">not counted<//>`}</td>
    <td class="nowrap"><${Time} at=${match.played_at} /></td>
  </tr>`;
}
