// The history of an alias: each change with its time, author and reason.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { useChangeToken, useData, useList } from "./data.js";
import { Await, EmptyState, leaguePath, LongText, ShowMore, Table, Time } from "./components.js";
import { Live } from "./report.js";

export function History({ league, about }) {
  const aliases = [...new Set(["champion", ...Object.keys(about.aliases ?? {})])];
  const [alias, setAlias] = useState("champion");
  const events = useList(apiPath(league, "aliases", alias, "history"), "history", useChangeToken("event"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">History</h2>
      ${aliases.length > 1 && html`<label class="inline">Alias <select value=${alias} onChange=${(event) => setAlias(event.target.value)}>
        ${aliases.map((each) => html`<option value=${each}>${each}</option>`)}</select></label>`}
    </div>
    <${Live}><${VersionAt} league=${league} alias=${alias} /><//>
    <${Await} result=${events}>${events.items && (events.items.length
      ? html`<${Table} caption="History of ${alias}, newest first" head=${[["Time"], ["Version"], ["Previous"], ["Change"], ["By"], ["Reason"]]} cls="full">
          ${events.items.map((each) => html`<${Row} key=${each.event} league=${league} event=${each} />`)}<//>`
      : html`<${EmptyState}>No version has had the alias ${alias} yet.<//>`)}<//>
    <${ShowMore} list=${events} />
  </section>`;
}

function Row({ league, event }) {
  const change = event.kind === "rollback" ? "rolled back" : event.verdict ? "promoted by the gate" : "set manually";
  return html`<tr>
    <td class="nowrap"><${Time} at=${event.at} date /></td>
    <th scope="row"><span class="ref">@${event.version}</span></th>
    <td>${event.previous == null ? html`<span class="muted">–</span>` : html`<span class="ref">@${event.previous}</span>`}</td>
    <td class="nowrap">${event.verdict ? html`<a href=${leaguePath(league, "verdicts", event.verdict)}>${change}</a>` : change}</td>
    <td class="wrap long"><${LongText}>${event.actor}<//></td>
    <td class="wrap long"><${LongText}>${event.reason}<//></td>
  </tr>`;
}

/** Look up the version at a given time. */
function VersionAt({ league, alias }) {
  const [input, setInput] = useState("");
  const instant = input && new Date(input);
  const isInstant = instant && !Number.isNaN(instant.getTime());
  const path = isInstant ? query(apiPath(league, "aliases", alias, "history"), { at: instant.toISOString() }) : null;
  const found = useData(path);
  const event = found.data && found.data.history[0];
  return html`<form class="lookup" onSubmit=${(event) => event.preventDefault()}>
    <label class="inline">Look up ${alias} at <input type="datetime-local" value=${input} onInput=${(event) => setInput(event.target.value)} /></label>
    <p role="status">${found.error ? found.error.message : found.data && (event
      ? html`<strong class="ref">${league}@${event.version}</strong>, since <${Time} at=${event.at} date />.`
      : `No version had the alias at that time.`)}</p>
  </form>`;
}
