// Server-sent events, read with `fetch` because `EventSource` cannot send an API key.

import { ApiError, pause, request } from "./api.js";
import { heard, onBack } from "./connection.js";

const IDLE_TIMEOUT = 10000; // milliseconds; the server sends a comment every two seconds
const MAX_RECONNECT_DELAY = 15000;

/**
 * Call `onEvent(name, data)` for each event of a stream, and reconnect when the stream ends, until the returned function is
 * called or `isLast(name, data)`. A hidden tab disconnects, because browsers limit the number of connections to a server.
 */
export function follow(path, onEvent, { isLast = () => false } = {}) {
  const closed = new AbortController();
  (async () => {
    for (let failures = 0; !closed.signal.aborted; ) {
      await untilVisible(closed.signal);
      const connection = new AbortController();
      const disconnect = () => (document.hidden || closed.signal.aborted) && connection.abort();
      document.addEventListener("visibilitychange", disconnect);
      closed.signal.addEventListener("abort", disconnect);
      try {
        const response = await request(path, { signal: connection.signal, raw: true });
        for await (const [name, data] of messages(response.body, connection)) {
          failures = 0;
          onEvent(name, data);
          if (isLast(name, data)) return;
        }
      } catch (error) {
        if (error instanceof ApiError && [401, 403, 404].includes(error.status)) return; // the page shows the same error
        failures += 1;
      } finally {
        document.removeEventListener("visibilitychange", disconnect);
        closed.signal.removeEventListener("abort", disconnect);
      }
      await reconnectDelay(failures, closed.signal);
    }
  })().catch(() => {}); // closed while waiting
  return () => closed.abort();
}

/** Wait longer after each failure, at most until the server responds again. */
async function reconnectDelay(failures, signal) {
  let ignore;
  const isBack = new Promise((resolve) => { ignore = onBack(resolve); });
  await Promise.race([pause(Math.min(MAX_RECONNECT_DELAY, 500 * 2 ** failures), signal).catch(() => {}), isBack]);
  ignore();
}

/** The events of a stream, as pairs of name and parsed data. Aborts the connection if nothing arrives for IDLE_TIMEOUT. */
async function* messages(body, connection) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const timer = setTimeout(() => connection.abort(), IDLE_TIMEOUT);
    const { value, done } = await reader.read().finally(() => clearTimeout(timer));
    if (done) return;
    heard();
    const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const fields = block.split("\n").map((line) => line.match(/^(event|data): ?(.*)$/)).filter(Boolean);
      const data = fields.filter(([, name]) => name === "data").map(([, , text]) => text).join("\n");
      if (data) yield [fields.find(([, name]) => name === "event")?.[2] ?? "message", JSON.parse(data)];
    }
  }
}

function untilVisible(signal) {
  if (!document.hidden) return Promise.resolve();
  return new Promise((resolve) => {
    const check = () => {
      if (document.hidden && !signal.aborted) return;
      document.removeEventListener("visibilitychange", check);
      signal.removeEventListener("abort", check);
      resolve();
    };
    document.addEventListener("visibilitychange", check);
    signal.addEventListener("abort", check);
  });
}
