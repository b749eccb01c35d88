// What components read: answers of the server that are fetched again when something says that they have changed.

import { createContext, useCallback, useContext, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { ask, Fault, follow, key, passes, query } from "./api.js";

const PAGE = 50;
const LARGEST = 100;
const LATER = 10000; // milliseconds until what could not be read is tried anew: nobody may sit before the page

/** {data, fault, again}. `path` null: nothing is asked. When `mark` changes, the old data stays until the new is there. */
export function useData(path, mark = "") {
  return useFetched(path, mark, (signal) => ask(path, { signal }));
}

/** {items, more, fault, again} of a paged list: `more()` shows the next page, null where there is none. */
export function useList(path, name, mark = "") {
  const [least, setLeast] = useState(PAGE);
  useEffect(() => setLeast(PAGE), [path]);
  const load = (signal) => collect(path, name, least, signal);
  const { data, fault, again } = useFetched(path, `${mark} ${least}`, load);
  return { items: data?.items ?? null, more: data?.next != null ? () => setLeast(data.items.length + PAGE) : null, fault, again };
}

/** Pages from the first one on, so that a list which is read again has no gap. */
async function collect(path, name, least, signal) {
  const items = [];
  let next = null;
  do {
    const limit = Math.min(LARGEST, least - items.length);
    const page = await ask(query(...withQuery(path, { limit, before: next })), { signal });
    items.push(...page[name]);
    next = page.next;
  } while (next != null && items.length < least);
  return { items, next };
}

function useFetched(path, mark, load) {
  const [state, setState] = useState({ path: null, data: null, fault: null });
  const [round, setRound] = useState(0);
  useEffect(() => {
    if (!path) return undefined;
    const closed = new AbortController();
    load(closed.signal).then(
      (data) => closed.signal.aborted || setState({ path, data, fault: null }),
      (fault) => closed.signal.aborted || setState((was) => ({ path, data: was.path === path ? was.data : null, fault })),
    );
    return () => closed.abort();
  }, [path, mark, round]);
  const again = useCallback(() => setRound((was) => was + 1), []);
  useEffect(() => {
    const timer = state.fault instanceof Fault && passes(state.fault, true) && setTimeout(again, LATER);
    return () => clearTimeout(timer);
  }, [state.fault]);
  return state.path === path ? { ...state, again } : { data: null, fault: null, again };
}

/** Why the key that was entered may not do this in a league, in a sentence; null if it may, or none was: then one is asked for. */
export function useRefusal(scope, league) {
  const shown = key.get();
  const own = useData(shown ? "/v1/key" : null, shown ?? "").data?.key;
  if (!own || (own.scopes.includes(scope) && (own.leagues?.includes(league) ?? true))) return null;
  return `The key ${own.name} may not ${scope} in ${league}.`;
}

/** Follow a stream of events while a component is there. */
export function useEvents(path, heard, ends) {
  const latest = useRef(heard);
  latest.current = heard;
  useEffect(() => (path ? follow(path, (name, data) => latest.current(name, data), { ends }) : undefined), [path]);
}

/** What the league's stream said last: names and marks. A page fetches again when a mark that it names has changed. */
export const Marks = createContext({});

export function useMark(...names) {
  const marks = useContext(Marks);
  return JSON.stringify(names.map((name) => marks[name] ?? null));
}

/** A number that grows every so many milliseconds, while the page is seen. */
export function useTicks(milliseconds) {
  const [ticks, setTicks] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => document.hidden || setTicks((was) => was + 1), milliseconds);
    return () => clearInterval(timer);
  }, [milliseconds]);
  return ticks;
}

/** {items, page, more, fault, again} of a list that is read by place: `?limit=&offset=`, with its `total`. */
export function useOffsets(path, name, mark = "") {
  const [least, setLeast] = useState(PAGE);
  useEffect(() => setLeast(PAGE), [path]);
  const load = async (signal) => {
    let page = null;
    const items = [];
    do {
      page = await ask(query(...withQuery(path, { limit: Math.min(LARGEST, least - items.length), offset: items.length })), { signal });
      items.push(...page[name]);
    } while (items.length < Math.min(least, page.total) && page[name].length);
    return { items, page };
  };
  const { data, fault, again } = useFetched(path, `${mark} ${least}`, load);
  const more = data && data.items.length < data.page.total ? () => setLeast(data.items.length + PAGE) : null;
  return { items: data?.items ?? null, page: data?.page ?? null, more, fault, again };
}

function withQuery(path, parameters) {
  const [place, given] = path.split("?");
  return [place, { ...Object.fromEntries(new URLSearchParams(given)), ...parameters }];
}
