// Client-side routing: links between pages change the address without reloading the document.

import { useLayoutEffect, useState } from "./vendor/preact-htm.js";
import { report } from "./report.js";

/** The path below which the server is: empty, or the prefix of a proxy (`/ai`). In a report, which is one file, the fragment contains addresses. */
export const ROOT = report ? "#" : new URL("..", import.meta.url).pathname.slice(0, -1);

/** Where all pages start. */
export const HOME = report ? `#/leagues/${report.league}` : `${ROOT}/`;

/** The address of the current page. */
export const currentURL = () => (report ? new URL((location.hash || HOME).slice(1), "file:///") : new URL(location.href));

const NAVIGATED = "league:navigated";

/** Navigate to another address. `replace`: replace the current history entry. */
export function navigate(address, { replace = false } = {}) {
  const current = currentURL();
  const target = new URL(address, current);
  const isOtherPage = target.pathname !== current.pathname;
  const written = report ? `#${target.pathname}${target.search}${target.hash}` : target;
  if (replace) history.replaceState(history.state, "", written);
  else history.pushState(null, "", written);
  if (isOtherPage) scrollTo(0, 0);
  dispatchEvent(new Event(NAVIGATED));
}

/** Remember values of the current history entry, which are in `history.state` when the user returns to it. */
export const remember = (values) => history.replaceState({ ...history.state, ...values }, "");

const RESTORING_TIME = 5000; // milliseconds for the content of a page to arrive
const BY_USER = ["wheel", "touchstart", "pointerdown", "keydown"];
let stopRestoring = null;

/** Remember how far a page is scrolled, and scroll there when the user returns to it and its content has arrived. */
export function keepPositions() {
  history.scrollRestoration = "manual"; // the browser's own precedes the content
  let timer = null;
  addEventListener("scroll", () => {
    clearTimeout(timer);
    if (!stopRestoring) timer = setTimeout(() => remember({ scroll: scrollY }), 100);
  });
  addEventListener(NAVIGATED, () => { clearTimeout(timer); stopRestoring?.(); });
  addEventListener("popstate", () => { clearTimeout(timer); restorePosition(); });
  restorePosition();
}

function restorePosition() {
  stopRestoring?.();
  const position = history.state?.scroll ?? 0;
  scrollTo(0, position);
  if (!position) return;
  const observer = new ResizeObserver(() => scrollTo(0, position));
  const timer = setTimeout(() => stopRestoring(), RESTORING_TIME);
  const stop = () => {
    observer.disconnect();
    clearTimeout(timer);
    BY_USER.forEach((event) => removeEventListener(event, stop));
    stopRestoring = null;
  };
  stopRestoring = stop;
  BY_USER.forEach((event) => addEventListener(event, stop, { passive: true }));
  observer.observe(document.body);
}

/** {path, parameters, fragment} of the current address, the path without ROOT; updated on navigation. */
export function useAddress() {
  const [address, setAddress] = useState(currentAddress);
  // A layout effect: an effect would run after the page is visible, and miss a navigation before.
  useLayoutEffect(() => {
    const update = () => setAddress(currentAddress());
    const events = [NAVIGATED, "popstate", "hashchange"];
    events.forEach((event) => addEventListener(event, update));
    return () => events.forEach((event) => removeEventListener(event, update));
  }, []);
  return address;
}

function currentAddress() {
  const { pathname, searchParams, hash } = currentURL();
  return { path: report ? pathname : pathname.slice(ROOT.length), parameters: searchParams, fragment: hash.slice(1) };
}

/** Handle clicks on links to these pages. The browser handles other links, downloads and clicks that open a new tab. */
export function followLinks() {
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[href]");
    if (!link || event.defaultPrevented || event.button || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    if (link.origin !== location.origin || link.target || link.hasAttribute("download")) return;
    if (!(link.pathname === `${ROOT}/` || link.pathname.startsWith(`${ROOT}/leagues`)) || link.getAttribute("href").startsWith("#")) return;
    event.preventDefault();
    navigate(link.href);
  });
}

/** The first route that matches a path: [value, parameters]. `routes`: pairs of a pattern (`/leagues/:league`) and a value. */
export function matchRoute(routes, path) {
  const parts = path.replace(/\/+$/, "").split("/");
  for (const [pattern, value] of routes) {
    const expected = pattern.replace(/\/+$/, "").split("/");
    if (expected.length !== parts.length || !expected.every((part, index) => part.startsWith(":") ? parts[index] : part === parts[index])) continue;
    const parameters = expected.map((part, index) => [part, parts[index]]).filter(([part]) => part.startsWith(":"));
    return [value, Object.fromEntries(parameters.map(([part, text]) => [part.slice(1), decoded(text)]))];
  }
  return [null, {}];
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // not a valid encoding
  }
}
