// The player for recorded games.

import { html, useEffect, useLayoutEffect, useRef, useState } from "./vendor/preact-htm.js";
import { apiPath, query, request } from "./api.js";
import { hasOneSide } from "./data.js";
import { useKeys } from "./keyboard.js";
import { Await, ErrorNotice, leaguePath, notify, Properties, useTitle } from "./components.js";
import { Chart, DataTable } from "./chart.js";
import { Analyst, describe, Moves, Picture } from "./step.js";
import { Live, report } from "./report.js";
import { currentURL, navigate, useAddress } from "./router.js";
import { number, plural, shortRef } from "./format.js";

const PAGE = 50;
const SPEEDS = [0.5, 1, 2, 4, 8];

export function Game({ league, schedule, position, game, about }) {
  const path = apiPath(league, "matches", schedule, position, "games", game);
  const [analysis, setAnalysis] = useState(null);
  const [recording, error, loadFrom] = useSteps(path, analysis);
  const analyst = html`<${Live}><${Analyst} league=${league} value=${analysis} onChange=${setAnalysis} /><//>`;
  const players = recording && [...new Set(Object.values(recording.players))];
  useTitle(players?.map(shortRef).join(hasOneSide(about) ? " and " : " against "), league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs">${report ? html`<a href=${leaguePath(league, "upsets")}>Upsets</a>` : html`<a href=${leaguePath(league, "matches", schedule, position)}>Match</a>`}</p>
    <div class="head"><h2 id="heading">Game ${game}</h2>${recording && !recording.fault && html`<${Live}><${DownloadGif} path=${path} name="${league}-${schedule}-${position}-${game}.gif" /><//>`}</div>
    <${Await} result=${{ data: recording, error, retry: () => loadFrom(0) }} message="Replaying the game …">${recording && (recording.fault
      ? html`<${ErrorNotice} error=${{ message: recording.fault }} />`
      : html`<${Player} recording=${recording} loadFrom=${loadFrom}>${analyst}<//>`)}<//>
    ${(error || recording?.fault) && analyst}
  </section>`;
}

/** The steps of a game, loaded in pages: [recording, error, loadFrom(step)]. `analysis`: number of a search version that evaluates them, or null. */
function useSteps(path, analysis) {
  const [recording, setRecording] = useState(null);
  const [error, setError] = useState(null);
  const requested = useRef(new Set());
  const newest = useRef(null);
  newest.current = analysis;
  const loadFrom = (step = 0) => {
    const from = step - (step % PAGE);
    const key = `${analysis} ${from}`;
    if (requested.current.has(key)) return;
    requested.current.add(key);
    request(query(path, { from: String(from), to: from + PAGE, analysis })).then(
      (loaded) => {
        if (newest.current !== analysis) return;
        setError(null);
        setRecording((previous) => ({ ...loaded, steps: { ...previous?.steps, ...byNumber(loaded.steps) } }));
      },
      (failure) => { requested.current.delete(key); if (newest.current === analysis) setError(failure); },
    );
  };
  useEffect(() => { requested.current.clear(); Object.keys(recording?.steps ?? { 0: null }).filter((step) => step % PAGE === 0).forEach((step) => loadFrom(Number(step))); }, [path, analysis]);
  return [recording, error, loadFrom];
}

const byNumber = (steps) => Object.fromEntries(steps.map((step) => [step.step, step]));

function Player({ recording, loadFrom, children }) {
  const { fragment } = useAddress();
  const { length: last, every, action_names: names } = recording;
  const clamped = (step) => {
    const wanted = Math.max(0, Math.floor(Number(step)) || 0);
    return wanted >= last ? last : wanted - (wanted % every);
  };
  const [at, setAt] = useState(() => clamped(fragment));
  const written = useRef(fragment);
  const [isPlaying, setIsPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  const step = recording.steps[at];
  const move = (to) => { setIsPlaying(false); setAt(clamped(to)); };
  const toggle = () => { if (!isPlaying && at === last) setAt(0); setIsPlaying(!isPlaying); };
  useEffect(() => { loadFrom(at); if (at + PAGE / 2 <= last) loadFrom(at + PAGE / 2); }, [at]);
  // A layout effect: an effect would run after the step is visible, and overwrite an address that the user enters before.
  useLayoutEffect(() => { written.current = String(at); navigate(`#${at}`, { replace: true }); }, [at]);
  useEffect(() => {
    const now = currentURL().hash.slice(1); // `fragment` may be older than what was written
    if (now !== written.current) move(now); // the user has changed the address
  }, [fragment]);
  useEffect(() => {
    if (!isPlaying || !step) return undefined; // waits until the step is loaded
    if (at === last) { setIsPlaying(false); return undefined; }
    const timer = setTimeout(() => setAt(clamped(at + every)), (last / every > 60 ? 250 : 800) / speed);
    return () => clearTimeout(timer);
  }, [isPlaying, at, speed, !!step]);
  useKeys((key) => {
    const action = { " ": toggle, ArrowLeft: () => move(at - 1), ArrowRight: () => move(at + every), Home: () => move(0), End: () => move(last),
      "+": () => setSpeed(otherSpeed(speed, 1)), "-": () => setSpeed(otherSpeed(speed, -1)) }[key];
    action?.();
    return !!action;
  });
  return html`<div class="player">
    <div class="screen">
      <${Picture} src=${step?.picture} alt=${describe(step, names)} />
      <div class="controls" role="group" aria-label="Playback">
        <button type="button" onClick=${() => move(0)} aria-label="First step"><${Icon} path="M2 2h2v10H2zM12 2v10L5 7z" /></button>
        <button type="button" onClick=${() => move(at - 1)} aria-label="Previous step"><${Icon} path="M11 2v10L3 7z" /></button>
        <button type="button" class="primary" onClick=${toggle}>${isPlaying ? "Pause" : "Play"}</button>
        <button type="button" onClick=${() => move(at + every)} aria-label="Next step"><${Icon} path="M3 2v10l8-5z" /></button>
        <button type="button" onClick=${() => move(last)} aria-label="Last step"><${Icon} path="M10 2h2v10h-2zM2 2v10l7-5z" /></button>
        <label class="inline">Speed <select value=${speed} onChange=${(event) => setSpeed(Number(event.target.value))}>${SPEEDS.map((each) => html`<option value=${each}>${each} ×</option>`)}</select></label>
      </div>
      <label class="seek"><span class="visually-hidden">Step</span>
        <input type="range" min="0" max=${last} value=${at} aria-valuetext="step ${at}: ${describe(step, names)}" onInput=${(event) => move(Number(event.target.value))} />
        <output>${at} of ${last}</output></label>
    </div>
    <div class="game-info" aria-live=${isPlaying ? "off" : "polite"}>
      <h3>${step ? (at === 0 ? "Start" : `Step ${at}`) : "Loading …"}${at === last ? " · end" : ""}</h3>
      ${every > 1 && html`<p class="muted small">One in ${every} steps is shown.</p>`}
      <${Moves} step=${step} names=${names} />
      ${children}
      <${Values} recording=${recording} />
      <${Players} recording=${recording} isOver=${at === last} />
      <p class="muted small keys"><kbd>Space</kbd> play or pause, <kbd>←</kbd> <kbd>→</kbd> previous or next step, <kbd>Home</kbd> <kbd>End</kbd> first or last step, <kbd>+</kbd> <kbd>−</kbd> speed</p>
    </div>
  </div>`;
}

/** The returns that a search expects before each move, for the first agent: the other one expects the opposite. */
function Values({ recording: { steps, players } }) {
  const [agent] = Object.keys(players);
  const moves = Object.values(steps).flatMap(({ step, moves: [move] }) => (move?.value == null ? [] : [{ step, value: move.agent === agent ? move.value : -move.value }]));
  if (moves.length < 2) return null;
  const chart = { x: moves.map(({ step }) => step), lines: [{ name: `expected return of ${agent}`, values: moves.map(({ value }) => value) }], format: (value) => number(value, 2) };
  return html`<${Chart} label="Expected return of ${agent} before each move" xName="step" yName="return" height=${160} ...${chart} />
    <${DataTable} caption="Expected return of ${agent}" xName="step" ...${chart} />`;
}

function Icon({ path }) {
  return html`<svg viewBox="0 0 14 14" width="14" height="14" aria-hidden="true"><path d=${path} /></svg>`;
}

/** The next faster (1) or slower (-1) speed. */
function otherSpeed(speed, by) {
  return SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, SPEEDS.indexOf(speed) + by))];
}

function Players({ recording: { players, returns, forfeits }, isOver }) {
  const agents = Object.entries(players);
  if (agents.length > 8) return html`<p class="muted">${plural(agents.length, "agent")}: ${[...new Set(Object.values(players))].join(", ")}.</p>`;
  return html`<${Properties} items=${agents.map(([agent, ref]) => [agent, html`<span class="ref">${ref}</span>
      ${isOver && html`<small>return ${number(returns[agent])}</small>`}`, "name"])} />
    ${isOver && forfeits.map((each) => html`<p>${each.ref} forfeited the game as ${each.agent} (${each.reason}).</p>`)}`;
}

/** Download the game as a GIF, with the API key. */
function DownloadGif({ path, name }) {
  const [busy, setBusy] = useState(false);
  const download = async () => {
    setBusy(true);
    try {
      const gif = await (await request(`${path}/video.gif`, { raw: true })).blob();
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(gif), download: name });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    } catch (error) {
      notify(`The GIF could not be created: ${error.message}`);
    }
    setBusy(false);
  };
  return html`<button type="button" onClick=${download} aria-busy=${busy} disabled=${busy}>${busy ? "Creating GIF …" : "Download GIF"}</button>`;
}
