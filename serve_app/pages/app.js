// The application: header, current page, and the API key dialog.

import { html, render, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { checkKey, key, onKeyNeeded } from "./api.js";
import { useLostSince } from "./connection.js";
import { useData } from "./data.js";
import { League } from "./league.js";
import { Leagues } from "./leagues.js";
import { Dialog, Form, Notifications, sentence } from "./components.js";
import { clock } from "./format.js";
import { Live } from "./report.js";
import { followLinks, HOME, keepPositions, matchRoute, ROOT, useAddress } from "./router.js";

const THEMES = ["system", "light", "dark"];
/** The filled part of the theme icon. */
const ICONS = { system: "M8 1.5a6.5 6.5 0 0 1 0 13z", light: "", dark: "M8 1.5a6.5 6.5 0 0 1 0 13a6.5 6.5 0 0 1 0-13z" };
const ROUTES = [["/", "leagues"], ["/leagues", "leagues"]];

function App() {
  const { path } = useAddress();
  const [prompt, setPrompt] = useState(null); // {message, done, reloads}: the API key dialog is open
  const [generation, setGeneration] = useState(0);
  const main = useRef();
  useEffect(() => onKeyNeeded((message) => new Promise((done) => setPrompt({ message, done }))), []);
  const isFirst = useRef(true);
  useEffect(() => {
    // The focused element may have been removed with the previous page.
    if (!isFirst.current && document.activeElement === document.body) main.current.focus({ preventScroll: true });
    isFirst.current = false;
  }, [path]);
  const close = (isNew) => {
    prompt.done(isNew);
    setPrompt(null);
    if (isNew && prompt.reloads) setGeneration((previous) => previous + 1);
  };
  const [isLeagues] = matchRoute(ROUTES, path);
  return html`
    <a class="skip-link" href="#main" onClick=${(event) => { event.preventDefault(); main.current.focus(); }}>Skip to content</a>
    <header class="header">
      <a class="brand" href=${HOME}><img src=${icon.href} alt="" width="24" height="24" /><span>Policy League</span></a>
      <${Live}><nav aria-label="Documentation"><a href="${ROOT}/docs">API</a></nav><//>
      <${Theme} />
      <${Live}>
        <${KeyButton} isPrompting=${!!prompt} onClick=${() => setPrompt({ message: "", done: () => {}, reloads: true })} />
        <${ServerNotice} />
      <//>
    </header>
    <main id="main" tabindex="-1" ref=${main} key=${generation}>
      ${isLeagues ? html`<${Leagues} />` : html`<${League} path=${path} />`}
    </main>
    <${Notifications} />
    ${prompt && html`<${KeyDialog} message=${prompt.message} close=${close} />`}`;
}

function ServerNotice() {
  const lostSince = useLostSince();
  return lostSince && html`<p class="lost" role="alert"><strong>The server is not responding.</strong> Last response: ${clock(lostSince)}. This page may be out of date.</p>`;
}

/** Shows whether the server accepts the entered key. It is checked again after each prompt. */
function KeyButton({ isPrompting, onClick }) {
  const entered = key.get();
  const { data, error } = useData(entered ? "/v1/key" : null, `${entered} ${isPrompting}`);
  const [sign, state] = !entered ? ["", "not entered"] : error?.status === 401 ? [" ✗", "not valid"] : data ? [" ✓", "valid"] : ["", "entered"];
  return html`<button type="button" class="quiet" onClick=${onClick}>API key${sign}<span class="visually-hidden">, ${state}</span></button>`;
}

function KeyDialog({ message, close }) {
  const submit = async (fields) => {
    const text = fields.get("key").trim();
    await checkKey(text);
    key.set(text);
    close(true);
  };
  return html`<${Dialog} title="API key" onClose=${() => close(false)}>
    ${message && html`<p role="alert">${sentence(message)}</p>`}
    <p class="muted">The key is stored until this tab is closed. Create a key with <code>league keys create</code>.</p>
    <${Form} submit=${submit} label="Use key" onCancel=${() => close(false)}>
      <label class="field">Key <input name="key" type="password" autocomplete="off" spellcheck="false" required autofocus /></label>
    <//>
    ${key.get() && html`<p><button type="button" class="link" onClick=${() => { key.set(null); close(true); }}>Remove key</button></p>`}
  <//>`;
}

/** Switch between the system, light and dark theme. */
function Theme() {
  const [theme, setTheme] = useState(() => document.documentElement.dataset.theme ?? "system");
  const change = () => {
    const next = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
    setTheme(next);
    if (next === "system") {
      delete document.documentElement.dataset.theme;
      localStorage.removeItem("theme");
    } else {
      document.documentElement.dataset.theme = next;
      localStorage.setItem("theme", next);
    }
    dispatchEvent(new Event("league:theme"));
  };
  return html`<button type="button" class="quiet theme" onClick=${change} title="Theme: ${theme}" aria-label="Theme: ${theme}">
    <svg viewBox="0 0 16 16" width="16" height="16" aria-hidden="true"><circle cx="8" cy="8" r="6.5" /><path d=${ICONS[theme]} /></svg></button>`;
}

const icon = document.querySelector("link[rel=icon]");
icon.href = icon.href; // absolute: browsers resolve it again when the address changes
followLinks();
keepPositions();
render(html`<${App} />`, document.getElementById("app"));
