// A league: what is always said of it, and below that one of its pages.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { of } from "./api.js";
import { Marks, useData, useEvents } from "./data.js";
import { Evaluation } from "./evaluation.js";
import { Evaluations, NewEvaluation } from "./evaluations.js";
import { Game } from "./game.js";
import { History } from "./history.js";
import { Matches } from "./matches.js";
import { Match } from "./match.js";
import { Await, Badge, Empty, Facts, league as at, sentence, useTitle, When } from "./parts.js";
import { Payoff } from "./payoff.js";
import { Play } from "./play.js";
import { Promotions } from "./promoting.js";
import { matched } from "./router.js";
import { Run, Runs } from "./runs.js";
import { Standings } from "./standings.js";
import { Traffic } from "./traffic.js";
import { Verdict, Verdicts } from "./verdicts.js";
import { Versions } from "./versions.js";
import { count, rate } from "./words.js";

const TABS = [
  ["Standings", "", Standings],
  ["Who beats whom", "payoff", Payoff],
  ["Versions", "versions", Versions],
  ["Verdicts", "verdicts", Verdicts],
  ["History", "history", History],
  ["Traffic", "traffic", Traffic],
  ["Evaluations", "evaluations", Evaluations],
  ["Training", "runs", Runs],
  ["Play", "play", Play],
];

const BELOW = "/leagues/:league";
const ROUTES = [
  ...TABS.map(([name, path, page]) => [`${BELOW}/${path}`, { tab: path, page, name, needsRoom: page === Play }]),
  [`${BELOW}/verdicts/:verdict`, { tab: "verdicts", page: Verdict }],
  [`${BELOW}/evaluations/new`, { tab: "evaluations", page: NewEvaluation }],
  [`${BELOW}/evaluations/:evaluation`, { tab: "evaluations", page: Evaluation }],
  [`${BELOW}/runs/:run`, { tab: "runs", page: Run }],
  [`${BELOW}/matches`, { tab: "payoff", page: Matches }],
  [`${BELOW}/matches/:schedule/:position`, { tab: "payoff", page: Match }],
  [`${BELOW}/matches/:schedule/:position/:game`, { tab: "payoff", page: Game, needsRoom: true }],
];

export function League({ path }) {
  const [route, names] = matched(ROUTES, path);
  if (!route) return html`<${Nowhere} path=${path} />`;
  return html`<${Known} key=${names.league} league=${names.league} route=${route} names=${names} />`;
}

function Nowhere({ path }) {
  useTitle("Not found");
  return html`<div class="title"><h1>There is no such page</h1></div>
    <${Empty}>Nothing is at <code>${path}</code>. <a href="/">All leagues</a> are on the first page.<//>`;
}

function Known({ league, route, names }) {
  const [marks, setMarks] = useState({});
  const about = useData(of(league), JSON.stringify([marks.aliases, marks.computed_at, marks.traffic, marks.serving]));
  useEvents(about.data && of(league, "events"), (name, data) => name === "league" && setMarks(data));
  useTitle(route.name, league);
  if (about.fault?.status === 404 || about.fault?.status === 400) {
    return html`<div class="title"><h1>There is no league <q>${league}</q></h1></div>
      <${Empty}>${sentence(about.fault.message)} <a href="/">All leagues</a> are on the first page.<//>`;
  }
  const Page = route.page;
  return html`<${Marks.Provider} value=${marks}>
    <div class="title">
      <p class="crumbs"><a href="/">Leagues</a></p>
      <h1>${league}</h1>
      ${about.data && html`<${Flags} of=${about.data} />`}
      ${about.data && html`<${Promotions} league=${league} champion=${about.data.champion} />`}
    </div>
    <${Await} of=${about}>${about.data && !route.needsRoom && html`<${Summary} of=${about.data} isFirst=${route.tab === ""} />`}<//>
    <${Tabs} league=${league} route=${route} />
    ${about.data && html`<${Page} key=${JSON.stringify(names)} ...${names} about=${about.data} />`}
  <//>`;
}

function Tabs({ league, route }) {
  const nav = useRef();
  useEffect(() => {
    // On a phone they do not all fit: the present one is to be seen.
    const shown = nav.current.querySelector("[aria-current]");
    nav.current.scrollLeft = shown.offsetLeft - (nav.current.clientWidth - shown.clientWidth) / 2;
  }, [route.tab]);
  return html`<nav class="tabs" ref=${nav} aria-label="Pages of ${league}"><ul>${TABS.map(([name, path, page]) => {
    const current = page === route.page ? "page" : "true"; // this page, or one below it
    return html`<li><a href=${path ? at(league, path) : at(league)} aria-current=${path === route.tab ? current : null}>${name}</a></li>`;
  })}</ul></nav>`;
}

/** What is tried on real requests just now. */
function Flags({ of: { league, traffic } }) {
  const tried = ["canary", "shadow"].filter((what) => traffic?.[what]);
  return tried.length > 0 && html`<p class="flags">${tried.map((what) => html`<a class="plainly" href=${at(league, "traffic")}>
    <${Badge} tone="accent">${what} ${String(traffic[what].version)}<//></a>`)}</p>`;
}

function Summary({ of: about, isFirst }) {
  const { league, summary } = about;
  const faults = about.faults ?? [];
  return html`
    <${Facts} of=${[
      ["Champion", about.champion == null ? "none yet" : html`<span class="ref">${league}@${about.champion}</span>`, "name"],
      ["Environment", html`<span class="path">${about.environment}</span>`, "name"],
      ["Games", count(summary?.games)],
      ["Different ones", count(summary?.distinct_games)],
      about.requests_per_second != null && ["Requests/s", rate(about.requests_per_second)],
      ["Standings of", html`<${When} at=${about.computed_at} />${about.computed_at && !about.up_to_date && html`<small>being renewed</small>`}`],
    ]} cls=${isFirst ? "" : "aside"} />
    ${faults.length > 0 && html`<div class="notice bad" role="alert"><p><strong>A replica does not serve what it should.</strong></p>
      <ul>${faults.map((fault) => html`<li>${fault}</li>`)}</ul></div>`}`;
}
