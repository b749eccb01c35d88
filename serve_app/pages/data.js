// Hooks that load data from the server and reload it when it has changed.

import { createContext, useCallback, useContext, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { ApiError, isTemporary, key, query, request } from "./api.js";
import { onBack } from "./connection.js";
import { follow } from "./events.js";
import { report } from "./report.js";
import { remember } from "./router.js";

const PAGE = 50;
const MAX_LIMIT = 100;
const RETRY_DELAY = 10000; // milliseconds until a failed load is retried without user action

/**
 * {data, error, retry}. Nothing is loaded while `path` is null. When `token` changes, the old data stays until the new data arrives.
 * `every`: milliseconds after which the data is loaded again, while the page is visible.
 */
export function useData(path, token = "", every = null) {
  return useLoaded(path, token, (signal) => request(path, { signal }), every);
}

/** {items, more, error, retry} of a list with cursor pagination. `more()` loads the next page; it is null on the last page. */
export function useList(path, name, token = "") {
  const [minimum, setMinimum] = useMinimum(path);
  const load = (signal) => loadPages(path, name, minimum, signal);
  const { data, error, retry } = useLoaded(path, `${token} ${minimum}`, load);
  return { items: data?.items ?? null, more: data?.next != null ? () => setMinimum(data.items.length + PAGE) : null, error, retry };
}

/** Load all pages from the first one, so that a reloaded list has no gaps. */
async function loadPages(path, name, minimum, signal) {
  const items = [];
  let next = null;
  do {
    const limit = Math.min(MAX_LIMIT, minimum - items.length);
    const page = await request(withQuery(path, { limit, before: next }), { signal });
    items.push(...page[name]);
    next = page.next;
  } while (next != null && items.length < minimum);
  return { items, next };
}

/** {items, page, more, error, retry} of a list with offset pagination (`?limit=&offset=`) and a `total`. */
export function useOffsetList(path, name, token = "") {
  const [minimum, setMinimum] = useMinimum(path);
  const load = async (signal) => {
    let page = null;
    const items = [];
    do {
      page = await request(withQuery(path, { limit: Math.min(MAX_LIMIT, minimum - items.length), offset: items.length }), { signal });
      items.push(...page[name]);
    } while (items.length < Math.min(minimum, page.total) && page[name].length);
    return { items, page };
  };
  const { data, error, retry } = useLoaded(path, `${token} ${minimum}`, load);
  const more = data && data.items.length < data.page.total ? () => setMinimum(data.items.length + PAGE) : null;
  return { items: data?.items ?? null, page: data?.page ?? null, more, error, retry };
}

/** The number of items of a list that are loaded: a page, or what was shown when the user left this history entry. */
function useMinimum(path) {
  const shown = history.state?.list === path ? history.state.shown : PAGE;
  const [state, setState] = useState({ path, minimum: shown });
  const set = (minimum) => { remember({ list: path, shown: minimum }); setState({ path, minimum }); };
  return [state.path === path ? state.minimum : PAGE, set];
}

function useLoaded(path, token, load, every = null) {
  const [state, setState] = useState({ path: null, data: null, error: null });
  const [attempt, setAttempt] = useState(0);
  useEffect(() => {
    if (!path) return undefined;
    const closed = new AbortController();
    load(closed.signal).then(
      (data) => closed.signal.aborted || setState({ path, data, error: null }),
      (error) => closed.signal.aborted || setState((previous) => ({ path, data: previous.path === path ? previous.data : null, error })),
    );
    return () => closed.abort();
  }, [path, token, attempt]);
  const retry = useCallback(() => setAttempt((previous) => previous + 1), []);
  useEffect(() => {
    const isFailed = state.error instanceof ApiError && isTemporary(state.error, true);
    const delay = isFailed ? RETRY_DELAY : state.error ? null : every;
    if (!delay || report) return undefined;
    let timer = null;
    const wait = () => { timer = setTimeout(() => (document.hidden ? wait() : retry()), delay); };
    wait();
    const ignore = onBack(() => isFailed && retry());
    return () => { clearTimeout(timer); ignore(); };
  }, [state]);
  return state.path === path ? { ...state, retry } : { data: null, error: null, retry };
}

/** Why the entered key lacks a scope in a league, as a sentence. Null if the key has the scope, or if no key was entered. */
export function useMissingScope(scope, league) {
  const entered = key.get();
  const own = useData(entered ? "/v1/key" : null, entered ?? "").data?.key;
  if (!own || (own.scopes.includes(scope) && (own.leagues?.includes(league) ?? true))) return null;
  return `The key ${own.name} does not have the scope ${scope} in ${league}.`;
}

/** Follow an event stream while the component is mounted. */
export function useEvents(path, onEvent, isLast) {
  const latest = useRef(onEvent);
  latest.current = onEvent;
  useEffect(() => (path && !report ? follow(path, (name, data) => latest.current(name, data), { isLast }) : undefined), [path]);
}

/** The newest `league` event. Its fields change whenever the corresponding data of the league changes. */
export const LeagueState = createContext({});

/** A string that changes when any of these fields of the league's event changes: pass it to useData or useList to reload. */
export function useChangeToken(...fields) {
  const state = useContext(LeagueState);
  return JSON.stringify(fields.map((field) => state[field] ?? null));
}

/** A number that increases at an interval, in milliseconds, while the page is visible. */
export function useTicks(milliseconds) {
  const [ticks, setTicks] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => document.hidden || setTicks((previous) => previous + 1), milliseconds);
    return () => clearInterval(timer);
  }, [milliseconds]);
  return ticks;
}

/** Whether all agents of a league are a team, so that contestants do not meet in a game. `about`: the league. */
export const hasOneSide = (about) => Object.keys(about.sides).length === 1;

/** Add parameters to a path that may have a query string. */
function withQuery(path, parameters) {
  const [base, given] = path.split("?");
  return query(base, { ...Object.fromEntries(new URLSearchParams(given)), ...parameters });
}
