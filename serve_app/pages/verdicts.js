// Verdicts of the gate, with reasons and evidence.

import { html } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { Chart, DataTable } from "./chart.js";
import { hasOneSide, useChangeToken, useData, useList } from "./data.js";
import { Await, EmptyState, leaguePath, Outcome, Properties, ShowMore, Table, Time, useTitle } from "./components.js";
import { Live, report } from "./report.js";
import { Term } from "./term.js";
import { count, interval, number, percent, shortRef, shortVerdict, signed } from "./format.js";

export function Verdicts({ league }) {
  const verdicts = useList(apiPath(league, "verdicts"), "verdicts", useChangeToken("verdicts", "computed_at"));
  const head = [["Candidate"], ["Opponent"], ["Outcome"], ["Games", "number"], [html`<${Term} name="LLR" />`, "number"], ["Elo", "number"], ["Decided"]];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Verdicts</h2></div>
    <p class="muted">The gate promotes a new version if statistical tests show that it is stronger. Select a verdict to see its evidence.</p>
    <${Await} result=${verdicts}>${verdicts.items && (verdicts.items.length
      ? html`<${Table} caption="Verdicts, newest first" head=${head} cls="full">
          ${verdicts.items.map((each) => html`<${Row} key=${each.verdict} league=${league} verdict=${each} />`)}<//>`
      : html`<${EmptyState}>No verdicts yet. Run <code>league nightly</code> <${Live}>or
          <a href=${leaguePath(league, "evaluations", "new")}>start a nightly run</a> <//>to test new versions.<//>`)}<//>
    <${ShowMore} list=${verdicts} />
  </section>`;
}

function Row({ league, verdict: each }) {
  return html`<tr>
    <th scope="row"><a href=${leaguePath(league, "verdicts", each.verdict)}><span class="ref">${shortRef(each.candidate)}</span></a></th>
    <td><span class="ref">${shortRef(each.opponent)}</span></td>
    <td class="nowrap"><${Outcome} value=${each.outcome} />${each.promoted && html` <span class="muted small">became champion</span>`}</td>
    <td class="number">${count(each.games)}</td>
    <td class="number">${number(each.llr)}</td>
    <td class="number">${signed(each.elo)}</td>
    <td class="nowrap"><${Time} at=${each.closed_at ?? each.opened_at} /></td>
  </tr>`;
}

export function Verdict({ league, verdict, about }) {
  const found = useData(apiPath(league, "verdicts", verdict), useChangeToken("verdicts", "computed_at"));
  const loaded = found.data;
  const relation = hasOneSide(about) ? "compared with" : "against";
  useTitle(loaded && `${shortRef(loaded.candidate)} ${relation} ${shortRef(loaded.opponent)}`, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${leaguePath(league, "verdicts")}>Verdicts</a></p>
    <${Await} result=${found}>${loaded && html`
      <div class="head"><h2 id="heading"><span class="ref">${loaded.candidate}</span> ${relation} <span class="ref">${loaded.opponent}</span></h2> <${Outcome} value=${loaded.outcome} /></div>
      ${loaded.reason && html`<p class="lead">${loaded.reason}</p>`}
      ${loaded.remedy && html`<p>${loaded.remedy}</p>`}
      ${loaded.earlier_game && html`<div class="notice" role="status"><p><strong>The game of this league has changed since.</strong> These games count in no current rating.</p>
        <${Live}><a href=${query(leaguePath(league), { game: loaded.earlier_game })}>Show the results of that game</a><//></div>`}
      <${Evidence} verdict=${loaded} />
      <${Statistics} league=${league} verdict=${loaded} />
      <${FurtherTests} verdict=${loaded} />
      ${loaded.exploitability?.difference && html`<${Exploitability} test=${loaded.exploitability} />`}
      ${loaded.confirmation && html`<${Confirmation} match=${loaded.confirmation} />`}`}
    <//>
  </section>`;
}

function Evidence({ verdict }) {
  if (!verdict.curve?.length) return null;
  const pairs = verdict.curve.map((point, index) => (Array.isArray(point) ? point : [index + 1, point]));
  const x = [0, ...pairs.map(([block]) => block)];
  const name = verdict.model === "returns" ? "log wealth" : "LLR";
  const lines = [{ name, values: [0, ...pairs.map(([, llr]) => llr)] }];
  const [low, high] = verdict.bounds;
  const label = `${name} after each of ${count(verdict.blocks)} blocks. Final value: ${number(verdict.llr)}. The candidate is promoted at ${number(high)} and rejected at ${number(low)}.`;
  return html`<h3>Evidence: <${Term} name=${name} /></h3>
    <${Chart} label=${label} x=${x} lines=${lines} xName="blocks" yName=${name} format=${(value) => number(value)}
      thresholds=${[{ name: `promote at ${signed(high, 2)}`, value: high, tone: "good" }, { name: `reject at ${signed(low, 2)}`, value: low, tone: "bad" }]} />
    <${DataTable} x=${x} lines=${lines} xName="blocks" caption="${name} after each block" format=${(value) => number(value)} />`;
}

function Statistics({ league, verdict }) {
  const [unit, digits] = verdict.model === "returns" ? ["return", 2] : ["Elo", 0];
  const difference = verdict.difference;
  return html`<${Properties} items=${[
      ["Verdict", html`<code>${shortVerdict(verdict.verdict)}</code>`],
      ["Games", report ? count(verdict.games) : html`<a href=${query(leaguePath(league, "matches"), { first: verdict.candidate, second: verdict.opponent })}>${count(verdict.games)}</a>`],
      verdict.unique_games != null && ["Unique games", count(verdict.unique_games)],
      [html`<${Term} name="block">Blocks<//>`, count(verdict.blocks)],
      ["Score", percent(verdict.score)],
      verdict.elo != null && ["Elo difference", html`${signed(verdict.elo)} <small>${interval(verdict.interval)}</small>`],
      difference && ["Difference in mean return", html`${signed(difference.mean, 2)} <small>${number(difference.low)} to ${number(difference.high)}</small>`],
      verdict.hypotheses && ["Hypotheses", html`${signed(verdict.hypotheses[0], digits)} vs ${signed(verdict.hypotheses[1], digits)} <small>${unit}, ${verdict.model}</small>`],
      verdict.alpha != null && ["Alpha budget", percent(verdict.alpha, verdict.alpha < 0.001 ? 3 : 2)],
      ["Opened", html`<${Time} at=${verdict.opened_at} date />`],
      verdict.closed_at && ["Decided", html`<${Time} at=${verdict.closed_at} date />`],
    ]} />
    ${verdict.counts?.length > 0 && html`<h3>Blocks by result</h3><${Counts} counts=${verdict.counts} />`}`;
}

/** The number of blocks by result, worst result for the candidate first. */
function Counts({ counts }) {
  const most = Math.max(1, ...counts);
  const name = (index) => (index === 0 ? "lost all" : index === counts.length - 1 ? "won all" : index === (counts.length - 1) / 2 ? "even" : "");
  return html`<ol class="counts" aria-label="Blocks by result, from worst to best for the candidate">${counts.map((each, index) => html`<li>
    <span class="value">${count(each)}</span><svg viewBox="0 0 10 100" preserveAspectRatio="none" aria-hidden="true"><rect x="0" width="10" y=${100 - (100 * each) / most} height=${(100 * each) / most} /></svg>
    <span class="muted small">${name(index)}</span></li>`)}</ol>`;
}

/** A difference with its interval. */
const spread = (difference) => html`${signed(difference.mean, 3)} <small>${number(difference.low, 3)} to ${number(difference.high, 3)}</small>`;

/** The tests after that against the champion: of each kind, the document has those that were started. All have a finding. */
function FurtherTests({ verdict }) {
  const tests = Object.values(verdict).flat().filter((value) => value?.finding);
  if (!tests.length) return null;
  const name = "Further tests";
  return html`<h3>${name}</h3>
    <${Table} caption=${name} head=${[["Opponent"], ["Finding"], [html`<${Term} name="LLR" />`, "number"], ["Score", "number"], ["Champion’s score", "number"], ["Difference", "number"], ["Elo", "number"]]}>
      ${tests.map((test) => html`<tr key=${test.schedule}><th scope="row"><span class="ref">${test.ref}</span>${test.exploits && html` <small>exploiter of ${test.exploits}</small>`}</th>
        <td>${test.finding}</td><td class="number">${number(test.llr)}</td><td class="number">${percent(test.score)}</td><td class="number">${percent(test.champion_score)}</td>
        <td class="number">${test.difference && spread(test.difference)}</td><td class="number">${signed(test.elo)} ${test.interval && html`<small>${interval(test.interval)}</small>`}</td></tr>`)}
    <//>`;
}

function Exploitability({ test }) {
  const rows = [test.candidate, test.champion].flatMap((version) => version.exploiters.map((exploiter) => [version, exploiter]));
  const others = test.difference_over_exploiters;
  const name = "Learned exploitability";
  return html`<h3>${name}</h3>
    <p>The exploiters of the candidate achieve ${spread(test.difference)} more than those of the champion.
      The 95 % interval is for these exploiters${others.low == null ? "" : html`; for others that are trained in the same way: ${spread(others)}`}.
      ${[test.candidate, test.champion].map((version) => html` A best response to <span class="ref">${version.ref}</span> scores at least ${percent(version.bound)}.`)}</p>
    <${Table} caption=${name} head=${[["Version"], ["Exploiter"], ["Games", "number"], ["Score", "number"], ["95 % interval"], ["Return gain", "number"]]}>
      ${rows.map(([version, exploiter]) => html`<tr key=${exploiter.ref}><th scope="row"><span class="ref">${version.ref}</span></th><td><span class="ref">${exploiter.ref}</span></td>
        <td class="number">${count(exploiter.games)}</td><td class="number">${percent(exploiter.score)}</td><td class="nowrap">${percent(exploiter.low)} to ${percent(exploiter.high)}</td>
        <td class="number nowrap">${exploiter.gain ? html`${signed(exploiter.gain.mean, 2)} <small>${number(exploiter.gain.low)} to ${number(exploiter.gain.high)}</small>` : "–"}</td></tr>`)}
    <//>`;
}

function Confirmation({ match }) {
  return html`<h3>Confirmation match</h3>
    <p>${count(match.games)} new games against ${match.opponent} after the promotion: score ${percent(match.score)},
      ${" "}${signed(match.elo)} Elo, 95 % interval ${interval(match.interval)}.</p>`;
}
