// Addresses and pages: a link within the pages changes the address and what is shown; nothing is loaded anew.

import { useEffect, useState } from "./vendor/preact-htm.js";

const MOVED = "league:moved";

/** Go to an address of these pages. `replace`: the one before is forgotten. */
export function go(address, { replace = false } = {}) {
  const isElsewhere = new URL(address, location.href).pathname !== location.pathname;
  history[replace ? "replaceState" : "pushState"](null, "", address);
  if (isElsewhere) scrollTo(0, 0);
  dispatchEvent(new Event(MOVED));
}

/** {path, parameters, fragment} of the address, followed. */
export function useAddress() {
  const [at, setAt] = useState(here);
  useEffect(() => {
    const look = () => setAt(here());
    const events = [MOVED, "popstate", "hashchange"];
    events.forEach((event) => addEventListener(event, look));
    return () => events.forEach((event) => removeEventListener(event, look));
  }, []);
  return at;
}

function here() {
  return { path: location.pathname, parameters: new URLSearchParams(location.search), fragment: location.hash.slice(1) };
}

/** Links of these pages are followed here; those elsewhere, and those that open a tab, by the browser. */
export function followLinks() {
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[href]");
    if (!link || event.defaultPrevented || event.button || event.metaKey || event.ctrlKey || event.shiftKey || event.altKey) return;
    if (link.origin !== location.origin || link.target || link.hasAttribute("download")) return;
    if (!(link.pathname === "/" || link.pathname.startsWith("/leagues")) || link.getAttribute("href").startsWith("#")) return;
    event.preventDefault();
    go(link.href);
  });
}

/** The first of `routes`, pairs of a pattern (`/leagues/:league`) and anything, that a path is like: [thing, names]. */
export function matched(routes, path) {
  const parts = path.replace(/\/+$/, "").split("/");
  for (const [pattern, found] of routes) {
    const wanted = pattern.replace(/\/+$/, "").split("/");
    if (wanted.length !== parts.length || !wanted.every((part, at) => part.startsWith(":") ? parts[at] : part === parts[at])) continue;
    const names = wanted.map((part, at) => [part, parts[at]]).filter(([part]) => part.startsWith(":"));
    return [found, Object.fromEntries(names.map(([part, text]) => [part.slice(1), decoded(text)]))];
  }
  return [null, {}];
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // not our writing
  }
}
