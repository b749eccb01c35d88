// What the gate decided, why, and on what evidence.

import { html } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { Chart, Numbers } from "./chart.js";
import { useData, useList, useMark } from "./data.js";
import { Await, Empty, Facts, league as at, More, Outcome, Table, useTitle, When } from "./parts.js";
import { count, interval, number, percent, signed, tail } from "./words.js";

export function Verdicts({ league }) {
  const verdicts = useList(of(league, "verdicts"), "verdicts", useMark("verdicts", "computed_at"));
  const head = [["Candidate"], ["Against"], ["Outcome"], ["Games", "number"], ["LLR", "number"], ["Elo", "number"], ["Decided"]];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Verdicts</h2></div>
    <p class="soft">A new version becomes champion when the gate finds it stronger. Each verdict has its evidence.</p>
    <${Await} of=${verdicts}>${verdicts.items && (verdicts.items.length
      ? html`<${Table} caption="Verdicts, newest first" head=${head} cls="full">
          ${verdicts.items.map((each) => html`<${Row} key=${each.verdict} league=${league} of=${each} />`)}<//>`
      : html`<${Empty}>Nothing was judged yet. <code>league nightly</code> judges new versions; so does a night that is
          <a href=${at(league, "evaluations", "new")}>started here</a>.<//>`)}<//>
    <${More} of=${verdicts} />
  </section>`;
}

function Row({ league, of: each }) {
  return html`<tr>
    <th scope="row"><a href=${at(league, "verdicts", each.verdict)}><span class="ref">${tail(each.candidate)}</span></a></th>
    <td><span class="ref">${tail(each.opponent)}</span></td>
    <td class="nowrap"><${Outcome} of=${each.outcome} />${each.promoted && html` <span class="soft small">became champion</span>`}</td>
    <td class="number">${count(each.games)}</td>
    <td class="number">${number(each.llr)}</td>
    <td class="number">${signed(each.elo)}</td>
    <td class="nowrap"><${When} at=${each.closed_at ?? each.opened_at} /></td>
  </tr>`;
}

export function Verdict({ league, verdict }) {
  const found = useData(of(league, "verdicts", verdict), useMark("verdicts", "computed_at"));
  const of_ = found.data;
  useTitle(of_ && `${tail(of_.candidate)} against ${tail(of_.opponent)}`, league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "verdicts")}>Verdicts</a></p>
    <${Await} of=${found}>${of_ && html`
      <div class="head"><h2 id="heading"><span class="ref">${of_.candidate}</span> against <span class="ref">${of_.opponent}</span></h2> <${Outcome} of=${of_.outcome} /></div>
      ${of_.reason && html`<p class="lead">${of_.reason}</p>`}
      <${Evidence} of=${of_} />
      <${Measures} league=${league} of=${of_} />
      ${of_.anchors?.length > 0 && html`<${Anchors} of=${of_.anchors} />`}
      ${of_.confirmation && html`<${Confirmation} of=${of_.confirmation} />`}`}
    <//>
  </section>`;
}

function Evidence({ of: judged }) {
  if (!judged.curve?.length) return null;
  const pairs = judged.curve.map((point, at) => (Array.isArray(point) ? point : [at + 1, point]));
  const x = [0, ...pairs.map(([block]) => block)];
  const name = judged.model === "returns" ? "log wealth" : "LLR";
  const lines = [{ name, values: [0, ...pairs.map(([, llr]) => llr)] }];
  const [low, high] = judged.bounds;
  const label = `${name} after each of ${count(judged.blocks)} blocks. It ended at ${number(judged.llr)}; at ${number(high)} the candidate is promoted, at ${number(low)} rejected.`;
  return html`<h3>Evidence</h3>
    <${Chart} label=${label} x=${x} lines=${lines} xName="blocks" yName=${name} words=${(value) => number(value)}
      levels=${[{ name: `promote at ${signed(high, 2)}`, value: high, tone: "good" }, { name: `reject at ${signed(low, 2)}`, value: low, tone: "bad" }]} />
    <${Numbers} x=${x} lines=${lines} xName="blocks" caption="${name} after each block" words=${(value) => number(value)} />`;
}

function Measures({ league, of: judged }) {
  const unit = judged.model === "returns" ? "return" : "Elo";
  const difference = judged.difference;
  return html`<${Facts} of=${[
      ["Games", html`<a href=${query(at(league, "matches"), { first: judged.candidate, second: judged.opponent })}>${count(judged.games)}</a>`],
      judged.distinct_games != null && ["Different ones", count(judged.distinct_games)],
      ["Blocks", count(judged.blocks)],
      ["Score", percent(judged.score)],
      judged.elo != null && ["Elo difference", html`${signed(judged.elo)} <small>${interval(judged.interval)}</small>`],
      difference && ["Difference of returns", html`${signed(difference.mean, 2)} <small>${number(difference.low)} to ${number(difference.high)}</small>`],
      judged.hypotheses && ["Hypotheses", html`${signed(judged.hypotheses[0])} or ${signed(judged.hypotheses[1])} <small>${unit}, ${judged.model}</small>`],
      judged.alpha != null && ["Error it may spend", percent(judged.alpha, 2)],
      ["Opened", html`<${When} at=${judged.opened_at} date />`],
      judged.closed_at && ["Decided", html`<${When} at=${judged.closed_at} date />`],
    ]} />
    ${judged.counts?.length > 0 && html`<h3>Blocks by result</h3><${Counts} of=${judged.counts} />`}`;
}

/** How the blocks came out, worst for the candidate first. */
function Counts({ of: counts }) {
  const most = Math.max(1, ...counts);
  const name = (at) => (at === 0 ? "lost all" : at === counts.length - 1 ? "won all" : at === (counts.length - 1) / 2 ? "even" : "");
  return html`<ol class="counts" aria-label="Blocks, from the worst result for the candidate to the best">${counts.map((each, at) => html`<li>
    <span class="value">${count(each)}</span><svg viewBox="0 0 10 100" preserveAspectRatio="none" aria-hidden="true"><rect x="0" width="10" y=${100 - (100 * each) / most} height=${(100 * each) / most} /></svg>
    <span class="soft small">${name(at)}</span></li>`)}</ol>`;
}

function Anchors({ of: anchors }) {
  return html`<h3>Not inferior to</h3>
    <${Table} caption="Tests of non-inferiority" head=${[["Anchor"], ["Outcome"], ["Margin", "number"], ["Games", "number"], ["LLR", "number"], ["Elo", "number"], ["95 % interval"]]}>
      ${anchors.map((each) => html`<tr key=${each.schedule}><th scope="row"><span class="ref">${each.ref}</span></th><td>${each.outcome}</td><td class="number">${each.margin}</td>
        <td class="number">${count(each.games)}</td><td class="number">${number(each.llr)}</td><td class="number">${signed(each.elo)}</td><td class="nowrap">${interval(each.interval)}</td></tr>`)}
    <//>`;
}

function Confirmation({ of: fresh }) {
  return html`<h3>Confirmed</h3>
    <p>A fresh match of ${count(fresh.games)} games against ${fresh.opponent} after the promotion: a score of ${percent(fresh.score)},
      ${" "}${signed(fresh.elo)} Elo, 95 % interval ${interval(fresh.interval)}.</p>`;
}
