// The pages of a league: title, summary and tabs, and the selected page below them.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { LeagueState, useData, useEvents } from "./data.js";
import { Evaluation } from "./evaluation.js";
import { Evaluations, NewEvaluation } from "./evaluations.js";
import { Game } from "./game.js";
import { History } from "./history.js";
import { Matches } from "./matches.js";
import { Match } from "./match.js";
import { Await, Badge, EmptyState, leaguePath, Properties, sentence, Time, useTitle } from "./components.js";
import { Nights } from "./nights.js";
import { Payoff } from "./payoff.js";
import { Play } from "./play.js";
import { Promotions } from "./promotion.js";
import { Live, report } from "./report.js";
import { HOME, matchRoute } from "./router.js";
import { Run, Runs } from "./runs.js";
import { Leaderboard } from "./leaderboard.js";
import { Traffic } from "./traffic.js";
import { Upsets } from "./upsets.js";
import { Verdict, Verdicts } from "./verdicts.js";
import { Versions } from "./versions.js";
import { count, dateTime, mixture, rate } from "./format.js";

const PAGES = [
  ["Leaderboard", "", Leaderboard],
  ["Payoff matrix", "payoff", Payoff],
  ["Upsets", "upsets", Upsets],
  ["Versions", "versions", Versions],
  ["Verdicts", "verdicts", Verdicts],
  ["History", "history", History],
  ["Traffic", "traffic", Traffic, "live"],
  ["Evaluations", "evaluations", Evaluations, "live"],
  ["Training", "training", Runs, "live"],
  ["Nights", "nights", Nights, "live"],
  ["Play", "play", Play, "live"],
];
const TABS = PAGES.filter(([, , , live]) => !(report && live)); // a report has results only

const REFRESH_INTERVAL = 5000;
const LEAGUE = "/leagues/:league";
const ROUTES = [
  ...TABS.flatMap(([name, path, page]) => [path, name.toLowerCase().replace(" ", "-")].map((part) => [`${LEAGUE}/${part}`, { tab: path, page, name, isCompact: page === Play }])),
  [`${LEAGUE}/verdicts/:verdict`, { tab: "verdicts", page: Verdict }],
  [`${LEAGUE}/evaluations/new`, { tab: "evaluations", page: NewEvaluation }],
  [`${LEAGUE}/evaluations/:evaluation`, { tab: "evaluations", page: Evaluation }],
  [`${LEAGUE}/training/:run`, { tab: "training", page: Run }],
  [`${LEAGUE}/runs`, { tab: "training", page: Runs, name: "Training" }], // as in the API, and in links of before
  [`${LEAGUE}/runs/:run`, { tab: "training", page: Run }],
  [`${LEAGUE}/matches`, { tab: "payoff", page: Matches }],
  [`${LEAGUE}/matches/:schedule/:position`, { tab: "payoff", page: Match }],
  [`${LEAGUE}/matches/:schedule/:position/:game`, { tab: "payoff", page: Game, isCompact: true }],
];

export function League({ path }) {
  const [route, parameters] = matchRoute(ROUTES, path);
  if (!route) return html`<${NotFound} path=${path} />`;
  return html`<${KnownLeague} key=${parameters.league} league=${parameters.league} route=${route} parameters=${parameters} />`;
}

function NotFound({ path }) {
  useTitle("Not found");
  return html`<div class="title"><h1>Page not found</h1></div>
    <${EmptyState}>There is no page at <code>${path}</code>. <a href=${HOME}>${report ? "Show the leaderboard" : "Show all leagues"}</a><//>`;
}

function KnownLeague({ league, route, parameters }) {
  const [state, setState] = useState({});
  const about = useData(apiPath(league), JSON.stringify([state.aliases, state.computed_at, state.traffic, state.serving]), REFRESH_INTERVAL);
  useEvents(about.data && apiPath(league, "events"), (name, data) => name === "league" && setState(data));
  useTitle(route.name, league);
  if (about.error?.status === 404 || about.error?.status === 400) {
    return html`<div class="title"><h1>League <q>${league}</q> not found</h1></div>
      <${EmptyState}>${sentence(about.error.message)} <a href=${HOME}>Show all leagues</a><//>`;
  }
  const Page = route.page;
  return html`<${LeagueState.Provider} value=${state}>
    <div class="title">
      <p class="crumbs">${report ? html`<span class="muted">Report of ${dateTime(report.made_at)}</span>` : html`<a href=${HOME}>Leagues</a>`}</p>
      <h1>${league}</h1>
      ${about.data && html`<${TrafficBadges} about=${about.data} />`}
      ${about.data && html`<${Live}><${Promotions} league=${league} champion=${about.data.champion} /><//>`}
    </div>
    <${Await} result=${about}>${about.data && !route.isCompact && html`<${Summary} about=${about.data} isFirst=${route.tab === ""} />`}<//>
    <${Tabs} league=${league} route=${route} />
    ${about.data && html`<${Page} key=${JSON.stringify(parameters)} ...${parameters} about=${about.data} />`}
  <//>`;
}

function Tabs({ league, route }) {
  const nav = useRef();
  useEffect(() => {
    // Scroll the selected tab into view: on a phone the tabs do not all fit.
    const selected = nav.current.querySelector("[aria-current]");
    nav.current.scrollLeft = selected.offsetLeft - (nav.current.clientWidth - selected.clientWidth) / 2;
  }, [route.tab]);
  return html`<nav class="tabs" ref=${nav} aria-label="Pages of ${league}"><ul>${TABS.map(([name, path, page]) => {
    const current = page === route.page ? "page" : "true"; // this page, or a page below it
    return html`<li><a href=${path ? leaguePath(league, path) : leaguePath(league)} aria-current=${path === route.tab ? current : null}>${name}</a></li>`;
  })}</ul></nav>`;
}

/** The current canary and shadow versions. */
function TrafficBadges({ about: { league, traffic } }) {
  const active = ["canary", "shadow"].filter((kind) => traffic?.[kind]);
  return active.length > 0 && html`<p class="flags">${active.map((kind) => html`<a class="plain-link" href=${leaguePath(league, "traffic")}>
    <${Badge} tone="accent">${kind} ${String(traffic[kind].version)}<//></a>`)}</p>`;
}

function Summary({ about, isFirst }) {
  const { league, summary } = about;
  const faults = about.faults ?? [];
  return html`
    <${Properties} items=${[
      ["Champion", about.champion == null ? "none" : html`<span class="ref">${league}@${about.champion}</span>${about.mixtures?.champion && html` <span class="muted small">${mixture(about.mixtures.champion)}</span>`}`, "name"],
      ["Environment", html`<span class="path">${about.environment}</span>`, "name"],
      ["Games", count(summary?.games)],
      ["Unique games", count(summary?.unique_games)],
      !report && about.requests_per_second != null && ["Requests/s", rate(about.requests_per_second)],
      !report && ["Last updated", html`<span class="nowrap"><${Time} at=${about.computed_at} /></span>${about.computed_at && !about.up_to_date && html`<small>updating</small>`}`],
    ]} cls=${isFirst ? "" : "aside"} />
    ${faults.length > 0 && html`<div class="notice bad" role="alert"><p><strong>A replica does not serve the expected version.</strong></p>
      <ul>${faults.map((fault) => html`<li>${fault}</li>`)}</ul></div>`}`;
}
