// Numbers, times and references as people read them. Pure.

const NONE = "–";
const counts = new Intl.NumberFormat("en");
const compact = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });

export const count = (value) => (value == null ? NONE : counts.format(value));

/** `+12`, `−3`, `0`: the minus is as wide as the plus. */
export function signed(value, digits = 0) {
  if (value == null) return NONE;
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? "−" : "+") + text;
}

/** Like `signed`, without a plus. */
export const number = (value, digits = 2) => signed(value, digits).replace("+", "");

/** As many digits as tell something: `0.0123`, `1,234`, `4.8M`. */
export function short(value) {
  if (value == null) return NONE;
  const size = Math.abs(value);
  if (size >= 1e15 || (size > 0 && size < 1e-3)) return value.toExponential(2).replaceAll("-", "−");
  if (size >= 1e5) return compact.format(value).replace("-", "−");
  return counts.format(Number(value.toPrecision(4))).replace("-", "−");
}

export const percent = (share, digits = 1) => (share == null ? NONE : `${(100 * share).toFixed(digits)} %`);

/** An interval, whose sides may be infinite (null). */
export function interval(span) {
  if (!span) return NONE;
  const [low, high] = span;
  return `${low == null ? "−∞" : signed(low)} to ${high == null ? "+∞" : signed(high)}`;
}

export const rate = (perSecond) =>
  perSecond == null ? NONE : perSecond === 0 ? "0" : perSecond < 10 ? perSecond.toFixed(1) : count(Math.round(perSecond));

/** `board@3`, or its number → `@3`; a script keeps its name. */
export function tail(ref) {
  const text = String(ref);
  return text.startsWith("script:") ? text : `@${text.slice(text.indexOf("@") + 1)}`;
}

const days = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", year: "numeric", hour: "2-digit", minute: "2-digit" });
const exact = new Intl.DateTimeFormat("en-GB", { dateStyle: "full", timeStyle: "long" });

export const moment = (iso) => days.format(new Date(iso));
export const exactly = (iso) => exact.format(new Date(iso));

/** `12 s ago`, `5 min ago`, `3 h ago`; after a day the date. */
export function ago(iso, now = Date.now()) {
  const seconds = Math.max(0, Math.round((now - new Date(iso)) / 1000));
  if (seconds < 5) return "just now";
  if (seconds < 60) return `${seconds} s ago`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ago`;
  return seconds < 86400 ? `${Math.floor(seconds / 3600)} h ago` : moment(iso);
}

/** `1 game`, `2 games`. */
export const several = (value, one, many = `${one}s`) => `${count(value)} ${value === 1 ? one : many}`;

/** An outcome's sign and word: colour is never the only sign. */
export const OUTCOMES = {
  promote: { sign: "▲", word: "promote", tone: "good" },
  reject: { sign: "▼", word: "reject", tone: "bad" },
  inconclusive: { sign: "◆", word: "inconclusive", tone: "plain" },
  void: { sign: "∅", word: "void", tone: "plain" },
  open: { sign: "…", word: "open", tone: "accent" },
};

export const STATES = {
  queued: { sign: "…", tone: "plain" },
  running: { sign: "●", tone: "accent" },
  done: { sign: "✓", tone: "good" },
  ended: { sign: "✓", tone: "good" },
  failed: { sign: "✗", tone: "bad" },
  stopped: { sign: "■", tone: "plain" },
  silent: { sign: "?", tone: "plain" },
};
