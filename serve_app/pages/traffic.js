// Canary and shadow: the current setting and the statistics of each version.

import { html } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { useChangeToken, useData } from "./data.js";
import { Await, EmptyState, Properties, Ref, Table, Time } from "./components.js";
import { count, number, percent } from "./format.js";

const REFRESH_INTERVAL = 5000;

export function Traffic({ league, about }) {
  const traffic = useData(apiPath(league, "traffic"), useChangeToken("traffic", "aliases"), REFRESH_INTERVAL);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Traffic</h2></div>
    <${Await} result=${traffic}>${traffic.data && html`<${Setting} traffic=${traffic.data} /><${Requests} league=${league} versions=${traffic.data.all.versions} champion=${about.champion} />
      <${Shadows} league=${league} shadows=${traffic.data.all.shadows} /><${Replicas} replicas=${traffic.data.replicas} />`}<//>
  </section>`;
}

function Setting({ traffic }) {
  const describe = (portion, what) => (portion ? html`<span class="ref">${typeof portion.version === "number" ? `@${portion.version}` : portion.version}</span>
    <small>${percent(portion.share)} ${what}</small>` : "off");
  return html`<${Properties} items=${[
      ["Canary", describe(traffic.canary, "of requests")],
      ["Shadow", describe(traffic.shadow, "of requests copied")],
      traffic.at && ["Changed", html`<${Time} at=${traffic.at} /> <small class="wrap">by ${traffic.actor}</small>`],
      traffic.reason && ["Reason", html`<span class="wrap">${traffic.reason}</span>`, "name"],
    ]} />
    ${!traffic.canary && !traffic.shadow && html`<p class="muted">The champion serves all requests. Use <code>league traffic</code> to send part of them to another version.</p>`}`;
}

function Requests({ league, versions, champion }) {
  if (!versions.length) return html`<${EmptyState}>No requests yet.<//>`;
  return html`<h3>Requests</h3>
    <${Table} caption="Requests by version, since the replicas started" head=${[["Version"], ["Requests", "number"], ["As canary", "number"], ["p50, ms", "number"], ["p95, ms", "number"], ["p99, ms", "number"]]}>
      ${versions.map((each) => html`<tr key=${each.version}><th scope="row"><${Ref} value="${league}@${each.version}" champion=${champion} /></th>
        <td class="number">${count(each.requests)}</td><td class="number">${count(each.as_canary)}</td><${Latency} values=${each.latency_ms} /></tr>`)}
    <//>`;
}

function Shadows({ league, shadows }) {
  if (!shadows.length) return null;
  return html`<h3>Shadow comparison</h3>
    <${Table} caption="Comparison of shadow candidates with champions" head=${[["Candidate"], ["Champion"], ["Same action", "number"], ["Requests", "number"], ["Failed", "number"], ["Dropped", "number"], ["p50, ms", "number"], ["p95, ms", "number"], ["p99, ms", "number"]]}>
      ${shadows.map((each) => html`<tr key=${`${each.candidate} ${each.champion}`}><th scope="row"><span class="ref">${league}@${each.candidate}</span></th><td>@${each.champion}</td>
        <td class="number">${percent(each.agreement)}</td><td class="number">${count(each.requests)}</td><td class="number">${count(each.failed)}</td><td class="number">${count(each.dropped)}</td><${Latency} values=${each.latency_ms} /></tr>`)}
    <//>`;
}

function Latency({ values }) {
  return ["p50", "p95", "p99"].map((name) => html`<td class="number">${number(values[name])}</td>`);
}

function Replicas({ replicas }) {
  return html`<h3>Replicas</h3>
    <${Table} caption="Replicas" head=${[["Replica"], ["Setting applied"], ["Error"]]}>
      ${replicas.map((each) => html`<tr key=${each.replica}><th scope="row"><code>${each.replica}</code></th><td>${each.follows ? "yes" : "pending"}</td><td class="wrap">${each.fault ?? html`<span class="muted">–</span>`}</td></tr>`)}
    <//>`;
}
