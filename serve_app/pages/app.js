// Where everything begins: the bar above, the page that the address names, and the dialog for a key.

import { html, render, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { key, onKeyNeeded } from "./api.js";
import { League } from "./league.js";
import { Leagues } from "./leagues.js";
import { Dialog, Form, Notifications, sentence } from "./parts.js";
import { followLinks, matched, useAddress } from "./router.js";

const THEMES = ["system", "light", "dark"];
/** Of the circle, what is dark. */
const SHAPES = { system: "M8 1.5a6.5 6.5 0 0 1 0 13z", light: "", dark: "M8 1.5a6.5 6.5 0 0 1 0 13a6.5 6.5 0 0 1 0-13z" };
const ROUTES = [["/", "leagues"], ["/leagues", "leagues"]];

function App() {
  const { path } = useAddress();
  const [wanted, setWanted] = useState(null); // {sentence, done}: a key is asked for
  const [generation, setGeneration] = useState(0);
  const main = useRef();
  useEffect(() => onKeyNeeded((why) => new Promise((done) => setWanted({ why, done }))), []);
  const isFirst = useRef(true);
  useEffect(() => {
    // What had the focus may be gone with the page before.
    if (!isFirst.current && document.activeElement === document.body) main.current.focus({ preventScroll: true });
    isFirst.current = false;
  }, [path]);
  const close = (isNew) => {
    wanted.done(isNew);
    setWanted(null);
    if (isNew && wanted.renews) setGeneration((was) => was + 1);
  };
  const [isLeagues] = matched(ROUTES, path);
  return html`
    <a class="skip" href="#main" onClick=${(event) => { event.preventDefault(); main.current.focus(); }}>To the content</a>
    <header class="bar">
      <a class="brand" href="/"><img src="/pages/mark.svg" alt="" width="24" height="24" /><span>Policy League</span></a>
      <nav aria-label="Elsewhere"><a href="/docs">API</a></nav>
      <${Theme} />
      <button type="button" class="quiet" onClick=${() => setWanted({ why: "", done: () => {}, renews: true })}>
        ${key.get() ? "Key ✓" : "Key"}<span class="unseen">${key.get() ? ", entered" : ", none entered"}</span>
      </button>
    </header>
    <main id="main" tabindex="-1" ref=${main} key=${generation}>
      ${isLeagues ? html`<${Leagues} />` : html`<${League} path=${path} />`}
    </main>
    <${Notifications} />
    ${wanted && html`<${KeyDialog} why=${wanted.why} close=${close} />`}`;
}

function KeyDialog({ why, close }) {
  const submit = async (fields) => {
    key.set(fields.get("key").trim());
    close(true);
  };
  return html`<${Dialog} title="API key" onClose=${() => close(false)}>
    ${why && html`<p role="alert">${sentence(why)}</p>`}
    <p class="soft">It is kept in this tab until it is closed. <code>league keys create</code> makes one.</p>
    <${Form} submit=${submit} label="Use this key" onCancel=${() => close(false)}>
      <label class="field">Key <input name="key" type="password" autocomplete="off" spellcheck="false" required autofocus /></label>
    <//>
    ${key.get() && html`<p><button type="button" class="link" onClick=${() => { key.set(null); close(true); }}>Forget the key</button></p>`}
  <//>`;
}

/** Which colours: the system's, light, dark, and round again. */
function Theme() {
  const [theme, setTheme] = useState(() => document.documentElement.dataset.theme ?? "system");
  const turn = () => {
    const chosen = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
    setTheme(chosen);
    if (chosen === "system") {
      delete document.documentElement.dataset.theme;
      localStorage.removeItem("theme");
    } else {
      document.documentElement.dataset.theme = chosen;
      localStorage.setItem("theme", chosen);
    }
    dispatchEvent(new Event("league:theme"));
  };
  return html`<button type="button" class="quiet theme" onClick=${turn} title="Colours: ${theme}" aria-label="Colours: ${theme}">
    <svg viewBox="0 0 16 16" width="16" height="16" aria-hidden="true"><circle cx="8" cy="8" r="6.5" /><path d=${SHAPES[theme]} /></svg></button>`;
}

followLinks();
render(html`<${App} />`, document.getElementById("app"));
