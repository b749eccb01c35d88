// Numbers, times and references as text. Pure functions.

const NONE = "–";
const counts = new Intl.NumberFormat("en");
const significant = new Intl.NumberFormat("en", { maximumSignificantDigits: 4 });
const compact = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });

export const count = (value) => (value == null ? NONE : counts.format(value));

/** `+12`, `−3`, `0`, with a minus sign as wide as the plus sign. */
export function signed(value, digits = 0) {
  if (value == null) return NONE;
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? "−" : "+") + text;
}

/** Like `signed`, without a plus sign. */
export const number = (value, digits = 2) => signed(value, digits).replace("+", "");

/** Rounded to significant digits, integers below 100,000 in full: `0.0123`, `61,440`, `4.8M`. */
export function short(value) {
  if (value == null) return NONE;
  const size = Math.abs(value);
  if (size >= 1e15 || (size > 0 && size < 1e-3)) return value.toExponential(2).replaceAll("-", "−");
  if (size >= 1e5) return compact.format(value).replace("-", "−");
  return (Number.isInteger(value) ? counts : significant).format(value).replace("-", "−");
}

export const percent = (share, digits = 1) => {
  if (share == null) return NONE;
  const rounded = (100 * share).toFixed(digits);
  return `${share && Number(rounded) === 0 ? (100 * share).toPrecision(2) : rounded} %`;
};

/** The search of a search version: `@3, 100 simulations, puct, 2.4 ms`. */
export const searched = ({ version, simulations, rule, ms }) => `@${version}, ${simulations} simulations, ${rule}, ${Number(ms.toPrecision(3))} ms`;
/** The members of a mixture: `60.0 % @3, 40.0 % @5`. */
export const mixture = (members) => members.map((each) => `${percent(each.probability)} @${each.version}`).join(", ");

/** An interval; a null bound is infinite. */
export function interval(bounds) {
  if (!bounds) return NONE;
  const [low, high] = bounds;
  return `${low == null ? "−∞" : signed(low)} to ${high == null ? "+∞" : signed(high)}`;
}

export const rate = (perSecond) =>
  perSecond == null ? NONE : perSecond === 0 ? "0" : perSecond < 10 ? perSecond.toFixed(1) : count(Math.round(perSecond));

/** A reference without its league: `board@3` or 3 → `@3`. Scripts and remote models keep their full name. */
export function shortRef(ref) {
  const text = String(ref);
  return text.startsWith("script:") || text.includes("://") ? text : `@${text.slice(text.indexOf("@") + 1)}`;
}

/** The short id of a verdict, which the commands accept: "connect_four-verdict-0f3a62d1c8b45e97-1b2c3d4e" → "0f3a62d1". */
export const shortVerdict = (verdict) => verdict.split("-verdict-").at(-1).slice(0, 8);

const medium = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", year: "numeric", hour: "2-digit", minute: "2-digit" });
const full = new Intl.DateTimeFormat("en-GB", { dateStyle: "full", timeStyle: "long" });

const time = new Intl.DateTimeFormat("en-GB", { timeStyle: "medium" });

/** `14:03:12`. */
export const clock = (at) => time.format(new Date(at));
export const dateTime = (iso) => medium.format(new Date(iso));
export const fullDateTime = (iso) => full.format(new Date(iso));

/** `12 s ago`, `5 min ago`, `3 h ago`; the date if it is more than a day ago. */
export function timeAgo(iso, now = Date.now()) {
  const seconds = Math.max(0, Math.round((now - new Date(iso)) / 1000));
  if (seconds < 5) return "just now";
  if (seconds < 60) return `${seconds} s ago`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ago`;
  return seconds < 86400 ? `${Math.floor(seconds / 3600)} h ago` : dateTime(iso);
}

/** `1 game`, `2 games`. */
export const plural = (value, one, many = `${one}s`) => `${count(value)} ${value === 1 ? one : many}`;

/** Symbol, label and color of each outcome and state. Color is never the only distinction. */
export const OUTCOMES = {
  promote: { sign: "▲", label: "promote", tone: "good" },
  reject: { sign: "▼", label: "reject", tone: "bad" },
  inconclusive: { sign: "◆", label: "inconclusive", tone: "plain" },
  void: { sign: "∅", label: "void", tone: "plain" },
  open: { sign: "…", label: "open", tone: "accent" },
};

export const STATES = {
  queued: { sign: "…", label: "queued", tone: "plain" },
  running: { sign: "●", label: "running", tone: "accent" },
  done: { sign: "✓", label: "done", tone: "good" },
  ended: { sign: "✓", label: "ended", tone: "good" },
  failed: { sign: "✗", label: "failed", tone: "bad" },
  stopped: { sign: "■", label: "stopped", tone: "plain" },
  silent: { sign: "?", label: "not responding", tone: "plain" },
};
