// Whether the server responds: one check for all pages.

import { useEffect, useState } from "./vendor/preact-htm.js";
import { ROOT } from "./router.js";

const BACK = "league:back";
const CHECK_INTERVAL = 1000; // milliseconds
const MAX_SILENCE = 3000; // before the server is asked; event streams of a league receive something every two seconds
const CHECK_TIMEOUTS = [2500, 2500]; // one lost response is no lost server
const LOST = [502, 503, 504]; // responses of a proxy without a server

let heardAt = Date.now();
let isSuspected = false; // a request got no response, whatever an open event stream receives

/** Record that the server has sent something. `status`: of a response. */
export function heard(status = 200) {
  if (!LOST.includes(status)) heardAt = Date.now();
}

/** Record that a request got no response. */
export function unanswered() {
  isSuspected = true;
}

/** When the server stopped responding, in milliseconds since 1970; null while it responds. A hidden tab does not check. */
export function useLostSince() {
  const [lostSince, setLostSince] = useState(null);
  useEffect(() => {
    let isClosed = false;
    (async () => {
      for (let wasLost = false; !isClosed; ) {
        await new Promise((resolve) => setTimeout(resolve, CHECK_INTERVAL));
        if (document.hidden || isClosed) continue;
        const isLost = (wasLost || isSuspected || Date.now() - heardAt > MAX_SILENCE) && !(await responds());
        if (isLost === wasLost) continue;
        wasLost = isLost;
        setLostSince(isLost ? heardAt : null);
        if (!isLost) dispatchEvent(new Event(BACK));
      }
    })();
    return () => { isClosed = true; };
  }, []);
  return lostSince;
}

/** Call `handler` when the server responds again. Returns a function that ends this. */
export function onBack(handler) {
  addEventListener(BACK, handler);
  return () => removeEventListener(BACK, handler);
}

async function responds() {
  isSuspected = false;
  for (const timeout of CHECK_TIMEOUTS) {
    const response = await fetch(`${ROOT}/v1/health/live`, { signal: AbortSignal.timeout(timeout), cache: "no-store" }).catch(() => null);
    if (response && !LOST.includes(response.status)) {
      heard();
      return true;
    }
  }
  return false;
}
