// A game of the ledger, played again: step by step, or by itself, at any speed.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { ask, of, query } from "./api.js";
import { useKeys } from "./keys.js";
import { Await, Facts, league as at, notify, Trouble, useTitle } from "./parts.js";
import { did, Moves, Picture } from "./stage.js";
import { go, useAddress } from "./router.js";
import { number, several, tail } from "./words.js";

const PAGE = 50;
const SPEEDS = [0.5, 1, 2, 4, 8];

export function Game({ league, schedule, position, game }) {
  const path = of(league, "matches", schedule, position, "games", game);
  const [show, fault, wants] = useSteps(path);
  useTitle(show && Object.values(show.cast).map(tail).join(" against "), league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "matches", schedule, position)}>The match</a></p>
    <div class="head"><h2 id="heading">Game ${game}</h2>${show && !show.fault && html`<${Film} path=${path} name="${league}-${schedule}-${position}-${game}.gif" />`}</div>
    <${Await} of=${{ data: show, fault, again: wants }} words="The game is being played again …">${show && (show.fault
      ? html`<${Trouble} fault=${{ message: show.fault }} />`
      : html`<${Player} show=${show} wants=${wants} />`)}<//>
  </section>`;
}

/** The steps of a game as far as they were fetched, in pages: [show, fault, wants(step)]. */
function useSteps(path) {
  const [show, setShow] = useState(null);
  const [fault, setFault] = useState(null);
  const asked = useRef(new Set());
  const wants = (step = 0) => {
    const from = step - (step % PAGE);
    if (asked.current.has(from)) return;
    asked.current.add(from);
    ask(query(path, { from: String(from), to: from + PAGE })).then(
      (found) => { setFault(null); setShow((was) => ({ ...found, steps: { ...was?.steps, ...byNumber(found.steps) } })); },
      (error) => { asked.current.delete(from); setFault(error); },
    );
  };
  useEffect(() => wants(0), [path]);
  return [show, fault, wants];
}

const byNumber = (steps) => Object.fromEntries(steps.map((step) => [step.step, step]));

function Player({ show, wants }) {
  const { fragment } = useAddress();
  const last = show.length;
  const [at, setAt] = useState(() => Math.min(last, Math.max(0, Number(fragment) || 0)));
  const [isPlaying, setIsPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  const step = show.steps[at];
  const move = (to) => { setIsPlaying(false); setAt(Math.min(last, Math.max(0, to))); };
  const toggle = () => { if (!isPlaying && at === last) setAt(0); setIsPlaying(!isPlaying); };
  useEffect(() => { wants(at); if (at + PAGE / 2 <= last) wants(at + PAGE / 2); go(`#${at}`, { replace: true }); }, [at]);
  useEffect(() => {
    if (!isPlaying || !step) return undefined; // it waits for what is not here yet
    if (at === last) { setIsPlaying(false); return undefined; }
    const timer = setTimeout(() => setAt(at + 1), (last > 60 ? 250 : 800) / speed);
    return () => clearTimeout(timer);
  }, [isPlaying, at, speed, !!step]);
  useKeys((pressed) => {
    const act = { " ": toggle, ArrowLeft: () => move(at - 1), ArrowRight: () => move(at + 1), Home: () => move(0), End: () => move(last),
      "+": () => setSpeed(faster(speed, 1)), "-": () => setSpeed(faster(speed, -1)) }[pressed];
    act?.();
    return !!act;
  });
  return html`<div class="player">
    <div class="screen">
      <${Picture} src=${step?.picture} words=${did(step)} />
      <div class="controls" role="group" aria-label="Steps of the game">
        <button type="button" onClick=${() => move(0)} aria-label="To the beginning"><${Icon} of="M2 2h2v10H2zM12 2v10L5 7z" /></button>
        <button type="button" onClick=${() => move(at - 1)} aria-label="One step back"><${Icon} of="M11 2v10L3 7z" /></button>
        <button type="button" class="primary" onClick=${toggle}>${isPlaying ? "Pause" : "Play"}</button>
        <button type="button" onClick=${() => move(at + 1)} aria-label="One step on"><${Icon} of="M3 2v10l8-5z" /></button>
        <button type="button" onClick=${() => move(last)} aria-label="To the end"><${Icon} of="M10 2h2v10h-2zM2 2v10l7-5z" /></button>
        <label class="inline">Speed <select value=${speed} onChange=${(event) => setSpeed(Number(event.target.value))}>${SPEEDS.map((each) => html`<option value=${each}>${each} ×</option>`)}</select></label>
      </div>
      <label class="seek"><span class="unseen">Step</span>
        <input type="range" min="0" max=${last} value=${at} aria-valuetext="step ${at}: ${did(step)}" onInput=${(event) => move(Number(event.target.value))} />
        <output>${at} of ${last}</output></label>
    </div>
    <div class="told" aria-live=${isPlaying ? "off" : "polite"}>
      <h3>${step ? (at === 0 ? "Start" : `Step ${at}`) : "Loading …"}${at === last ? " · end" : ""}</h3>
      <${Moves} of=${step} />
      <${Cast} of=${show} isOver=${at === last} />
      <p class="soft small keys"><kbd>Space</kbd> plays, <kbd>←</kbd> <kbd>→</kbd> step, <kbd>Home</kbd> <kbd>End</kbd>, <kbd>+</kbd> <kbd>−</kbd> speed.</p>
    </div>
  </div>`;
}

function Icon({ of }) {
  return html`<svg viewBox="0 0 14 14" width="14" height="14" aria-hidden="true"><path d=${of} /></svg>`;
}

function faster(speed, by) {
  return SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, SPEEDS.indexOf(speed) + by))];
}

function Cast({ of: { cast, returns, forfeits }, isOver }) {
  const agents = Object.entries(cast);
  if (agents.length > 8) return html`<p class="soft">${several(agents.length, "agent")}: ${[...new Set(Object.values(cast))].join(", ")}.</p>`;
  return html`<${Facts} of=${agents.map(([agent, ref]) => [agent, html`<span class="ref">${ref}</span>
      ${isOver && html`<small>return ${number(returns[agent])}</small>`}`, "name"])} />
    ${isOver && forfeits.map((each) => html`<p>${each.ref} forfeited the game as ${each.agent}: ${each.reason}.</p>`)}`;
}

/** The game as a GIF: fetched with the key, then handed to the browser. */
function Film({ path, name }) {
  const [busy, setBusy] = useState(false);
  const fetchFilm = async () => {
    setBusy(true);
    try {
      const film = await (await ask(`${path}/film.gif`, { whole: true })).blob();
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(film), download: name });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    } catch (fault) {
      notify(`There is no film: ${fault.message}`);
    }
    setBusy(false);
  };
  return html`<button type="button" onClick=${fetchFilm} aria-busy=${busy} disabled=${busy}>${busy ? "Filming …" : "Download GIF"}</button>`;
}
