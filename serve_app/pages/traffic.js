// Canary and shadow: which version is tried on real requests, and what that has shown.

import { html } from "./vendor/preact-htm.js";
import { of } from "./api.js";
import { useData, useMark, useTicks } from "./data.js";
import { Await, Empty, Facts, Ref, Table, When } from "./parts.js";
import { count, number, percent } from "./words.js";

const EVERY = 5000;

export function Traffic({ league, about }) {
  const traffic = useData(of(league, "traffic"), `${useMark("traffic", "aliases")} ${useTicks(EVERY)}`);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Traffic</h2></div>
    <${Await} of=${traffic}>${traffic.data && html`<${State} of=${traffic.data} /><${Served} league=${league} of=${traffic.data.all.versions} champion=${about.champion} />
      <${Shadows} league=${league} of=${traffic.data.all.shadows} /><${Replicas} of=${traffic.data.replicas} />`}<//>
  </section>`;
}

function State({ of: traffic }) {
  const words = (portion, what) => (portion ? html`<span class="ref">${typeof portion.version === "number" ? `@${portion.version}` : portion.version}</span>
    <small>${what} ${percent(portion.share)}</small>` : "off");
  return html`<${Facts} of=${[
      ["Canary", words(traffic.canary, "answers")],
      ["Shadow", words(traffic.shadow, "is shown")],
      traffic.at && ["Set", html`<${When} at=${traffic.at} /> <small class="words">by ${traffic.actor}</small>`],
      traffic.reason && ["Reason", html`<span class="words">${traffic.reason}</span>`, "name"],
    ]} />
    ${!traffic.canary && !traffic.shadow && html`<p class="soft">The champion answers everything. <code>league traffic</code> tries a version on real requests.</p>`}`;
}

function Served({ league, of: versions, champion }) {
  if (!versions.length) return html`<${Empty}>Nothing has been asked yet.<//>`;
  return html`<h3>Requests</h3>
    <${Table} caption="Requests by version, since the replicas started" head=${[["Version"], ["Requests", "number"], ["As canary", "number"], ["p50, ms", "number"], ["p95, ms", "number"], ["p99, ms", "number"]]}>
      ${versions.map((each) => html`<tr key=${each.version}><th scope="row"><${Ref} of="${league}@${each.version}" champion=${champion} /></th>
        <td class="number">${count(each.requests)}</td><td class="number">${count(each.as_canary)}</td><${Times} of=${each.latency_ms} /></tr>`)}
    <//>`;
}

function Shadows({ league, of: shadows }) {
  if (!shadows.length) return null;
  return html`<h3>What shadows have shown</h3>
    <${Table} caption="Candidates held against champions" head=${[["Candidate"], ["Champion"], ["Same action", "number"], ["Requests", "number"], ["Failed", "number"], ["Dropped", "number"], ["p50, ms", "number"], ["p95, ms", "number"], ["p99, ms", "number"]]}>
      ${shadows.map((each) => html`<tr key=${`${each.candidate} ${each.champion}`}><th scope="row"><span class="ref">${league}@${each.candidate}</span></th><td>@${each.champion}</td>
        <td class="number">${percent(each.agreement)}</td><td class="number">${count(each.requests)}</td><td class="number">${count(each.failed)}</td><td class="number">${count(each.dropped)}</td><${Times} of=${each.latency_ms} /></tr>`)}
    <//>`;
}

function Times({ of: latency }) {
  return ["p50", "p95", "p99"].map((name) => html`<td class="number">${number(latency[name])}</td>`);
}

function Replicas({ of: replicas }) {
  return html`<h3>Replicas</h3>
    <${Table} caption="Replicas" head=${[["Replica"], ["Follows"], ["Fault"]]}>
      ${replicas.map((each) => html`<tr key=${each.replica}><th scope="row"><code>${each.replica}</code></th><td>${each.follows ? "yes" : "not yet"}</td><td class="words">${each.fault ?? html`<span class="soft">–</span>`}</td></tr>`)}
    <//>`;
}
