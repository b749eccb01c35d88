// Line charts, drawn by uPlot in the colors of the page. Each chart has a text alternative and a table of its values.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { short } from "./format.js";

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [4, 2], [12, 4]];
/** With six colors, these dash patterns distinguish 36 lines. */
const dashOf = (number) => DASHES[(number + Math.floor(number / 6)) % 6];
const FONT = "12px system-ui, sans-serif";

/**
 * `x`: ascending x values. `lines`: {name, values, dots}; a missing value is null, `dots` draws a dot at each value.
 * `thresholds`: horizontal lines {name, value, tone}. `intervals`: [low, high] or null for each value of the first line.
 * `markers`: whether each value of the first line is marked. `format`: value → text.
 */
export function Chart({ label, x, lines, thresholds = [], intervals, markers, xName, yName, height = 260, format = short }) {
  const container = useRef();
  const plot = useRef(null);
  const [index, setIndex] = useState(null);
  const themeChanges = useThemeChanges();
  const shape = JSON.stringify([lines.map((line) => line.name), thresholds, xName, yName, height, !!intervals, !!markers, themeChanges]);
  const latest = useRef();
  latest.current = { x, lines, thresholds, intervals, markers };

  useEffect(() => {
    let observer = null;
    let isUnmounted = false;
    import("./vendor/uplot.js").then(({ default: UPlot }) => {
      if (isUnmounted) return;
      const colors = resolveColors(container.current);
      const options = optionsOf({ colors, latest, xName, yName, height, format, width: container.current.clientWidth, onCursor: setIndex });
      plot.current = new UPlot(options, dataOf(latest.current), container.current);
      container.current.querySelector("canvas").setAttribute("aria-hidden", "true");
      observer = new ResizeObserver(([{ contentRect }]) => plot.current.setSize({ width: contentRect.width, height }));
      observer.observe(container.current);
    });
    return () => {
      isUnmounted = true;
      observer?.disconnect();
      plot.current?.destroy();
      plot.current = null;
    };
  }, [shape]);
  useEffect(() => { plot.current?.setData(dataOf(latest.current)); }, [x, lines, intervals, markers]);

  return html`<figure class="chart">
    <div class="plot" style=${{ minHeight: `${height}px` }} ref=${container} role="img" aria-label=${label}></div>
    <figcaption><ul class="legend">${lines.map((line, number) => html`<li>
      <svg viewBox="0 0 26 8" width="26" height="8" aria-hidden="true"><line class="line c${number % 6}" x1="0" x2="26" y1="4" y2="4" stroke-dasharray=${dashOf(number).join(" ")} /></svg>
      ${line.name} <span class="value">${format(line.values[index ?? last(line.values)])}</span></li>`)}
      <li class="muted position">${index != null && `${xName} ${short(x[index])}`}</li></ul></figcaption>
  </figure>`;
}

/** The values of a chart as a collapsible table. */
export function DataTable({ x, lines, xName, caption, format = short }) {
  const [isOpen, setIsOpen] = useState(false);
  return html`<details class="numbers" onToggle=${(event) => setIsOpen(event.target.open)}><summary>Show as table</summary>
    ${isOpen && html`<div class="wide tall" tabindex="0" role="region" aria-label=${caption}><table>
      <caption class="visually-hidden">${caption}</caption>
      <thead><tr><th scope="col" class="number">${xName}</th>${lines.map((line) => html`<th scope="col" class="number">${line.name}</th>`)}</tr></thead>
      <tbody>${x.map((value, row) => html`<tr><th scope="row" class="number">${short(value)}</th>${lines.map((line) => html`<td class="number">${format(line.values[row])}</td>`)}</tr>`)}</tbody>
    </table></div>`}
  </details>`;
}

/** A number that changes when charts must be redrawn because the theme has changed. */
function useThemeChanges() {
  const [changes, setChanges] = useState(0);
  useEffect(() => {
    const scheme = matchMedia("(prefers-color-scheme: dark)");
    const update = () => setChanges((previous) => previous + 1);
    scheme.addEventListener("change", update);
    addEventListener("league:theme", update);
    return () => { scheme.removeEventListener("change", update); removeEventListener("league:theme", update); };
  }, []);
  return changes;
}

/** The current values of the CSS colors, for the canvas. */
function resolveColors(element) {
  const probe = element.appendChild(document.createElement("i"));
  const names = ["muted", "border", "background", "good", "bad", "accent", "c0", "c1", "c2", "c3", "c4", "c5"];
  const entries = names.map((name) => {
    probe.style.color = `var(--${name})`;
    return [name, getComputedStyle(probe).color];
  });
  probe.remove();
  return Object.fromEntries(entries);
}

const dataOf = ({ x, lines }) => [x, ...lines.map((line) => line.values)];

function last(values) {
  for (let index = values.length - 1; index >= 0; index -= 1) if (values[index] != null) return index;
  return 0;
}

function optionsOf({ colors, latest, xName, yName, height, format, width, onCursor }) {
  const { lines } = latest.current;
  const axis = { stroke: colors.muted, font: FONT, labelFont: FONT, grid: { stroke: colors.border, width: 1 }, ticks: { stroke: colors.border, width: 1, size: 4 }, labelGap: 2 };
  return {
    width: Math.max(200, width),
    height,
    legend: { show: false },
    cursor: { y: false, drag: { x: true, y: false }, points: { size: 7 } },
    scales: { x: { time: false, range: (_, low, high) => padded(low, high, 0.02) }, y: { range: (_, low, high) => rangeOf(latest.current, low, high) } },
    axes: [
      { ...axis, label: xName, labelSize: 18, size: 30, grid: { show: false }, values: (_, ticks) => ticks.map((tick) => (Number.isInteger(tick) ? short(tick) : "")) },
      { ...axis, label: yName, labelSize: 18, size: 52, values: (_, ticks) => ticks.map((tick) => format(tick)) },
    ],
    series: [{}, ...lines.map((line, number) => ({
      label: line.name,
      stroke: colors[`c${number % 6}`],
      width: 1.75,
      dash: dashOf(number),
      spanGaps: true,
      points: { show: line.dots ?? line.values.length < 2, size: 7, fill: colors.background },
    }))],
    hooks: {
      setCursor: [(plot) => onCursor(plot.cursor.idx ?? null)],
      drawClear: [(plot) => drawThresholds(plot, latest.current.thresholds, colors)],
      draw: [(plot) => drawIntervals(plot, latest.current, colors), (plot) => drawMarkers(plot, latest.current, colors)],
    },
  };
}

/** The y range that includes all lines, thresholds and intervals, with padding. */
function rangeOf({ thresholds, intervals }, low, high) {
  const ends = [low, high, ...thresholds.map((threshold) => threshold.value), ...(intervals ?? []).flatMap((each) => each ?? [])].filter((end) => end != null);
  return ends.length ? padded(Math.min(...ends), Math.max(...ends), 0.08) : [0, 1];
}

function padded(low, high, share) {
  const padding = high > low ? (high - low) * share : Math.max(1, Math.abs(high)) * share * 5;
  return [low - padding, high + padding];
}

function drawThresholds(plot, thresholds, colors) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  for (const { name, value, tone } of thresholds) {
    const y = plot.valToPos(value, "y", true);
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colors[tone] ?? colors.muted;
    ctx.lineWidth = scale;
    ctx.setLineDash([5 * scale, 4 * scale]);
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    ctx.font = `${12 * scale}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    ctx.fillText(name, bbox.left + 6 * scale, y + (value < 0 ? 14 : -6) * scale);
    ctx.restore();
  }
}

function drawIntervals(plot, { x, intervals }, colors) {
  if (!intervals) return;
  const { ctx } = plot;
  const scale = devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = colors.c0;
  ctx.globalAlpha = 0.5;
  ctx.lineWidth = 1.5 * scale;
  ctx.beginPath();
  intervals.forEach((interval, index) => {
    if (!interval) return;
    const left = plot.valToPos(x[index], "x", true);
    ctx.moveTo(left, plot.valToPos(interval[0], "y", true));
    ctx.lineTo(left, plot.valToPos(interval[1], "y", true));
  });
  ctx.stroke();
  ctx.restore();
}

function drawMarkers(plot, { x, lines, markers }, colors) {
  if (!markers) return;
  const { ctx } = plot;
  const size = 6 * devicePixelRatio;
  ctx.save();
  ctx.fillStyle = colors.c0;
  markers.forEach((isMarked, index) => {
    const value = lines[0].values[index];
    if (!isMarked || value == null) return;
    const [left, top] = [plot.valToPos(x[index], "x", true), plot.valToPos(value, "y", true)];
    ctx.beginPath();
    for (const [across, up] of [[0, -size], [size, 0], [0, size], [-size, 0]]) ctx.lineTo(left + across, top + up);
    ctx.fill();
  });
  ctx.restore();
}
