"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (packed) => packed.dtype === "i2" ? Float32Array.from(new Int16Array(bytes(packed.bdata).buffer), (v) => v === -32768 ? NaN : v / 1000) : new Float32Array(bytes(packed.bdata).buffer);

  // ---- plots -------------------------------------------------------------------------------------------------------------------
  const plots = [];
  const whole = data.span;
  let range = whole.slice();
  const isDark = () => {
    const stated = document.documentElement.dataset.theme;
    return stated ? stated === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  };
  // black and dark blues do not show on a dark page
  function shown(color) {
    if (color === "ink" || color === "#000000") return css("--ink");
    if (!isDark() || !/^#[0-9a-f]{6}$/i.test(color)) return color;
    if (color === "#0072B2") return "#6f86ff";
    const parts = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16)), light = (0.3 * parts[0] + 0.59 * parts[1] + 0.11 * parts[2]) / 255;
    if (light > 0.42) return color;
    const white = (0.42 - light) / (1 - light);
    return "#" + parts.map((v) => Math.round(v + white * (255 - v)).toString(16).padStart(2, "0")).join("");
  }
  const faint = (color) => { const c = shown(color); return c.startsWith("#") && c.length === 7 ? c + "2e" : c; };

  const hidden = new Set(); // trains that are not drawn in any plot
  const drawn_now = (t) => !(t.group && hidden.has(t.group));
  const when = (time) => { // a time of the run as words
    if (!data.clock) return +time.toFixed(3) + " s";
    const s = Math.round(time), two = (n) => String(n).padStart(2, "0");
    return `${two(Math.floor(s / 3600))}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)}`;
  };
  const narrow = () => innerWidth < 640;

  const inner = () => narrow() ? 210 : 250; // height of a plot within its axes [px], about
  function extent(panel) { // of what is drawn in a panel, and of its places
    let low = Infinity, high = -Infinity;
    for (const t of panel.traces) if (t.y.bdata) for (const y of floats(t.y)) { if (y < low) low = y; if (y > high) high = y; }
    for (const p of panel.places || []) { low = Math.min(low, p.value); high = Math.max(high, p.value); }
    return [low, high];
  }

  // places by name: a name above its line, below it where another is near above, and none where neither has room
  function named(panel) {
    if (!(panel.places || []).length) return [];
    const [low, high] = extent(panel), apart = 17 / inner() * (high - low), taken = [], found = [];
    for (const p of [...panel.places].sort((a, b) => (b.stop || 0) - (a.stop || 0) || b.value - a.value)) {
      const side = [1, -1].find((s) => taken.every((y) => Math.abs(y - (p.value + s * apart / 2)) >= apart));
      if (!side) continue;
      taken.push(p.value + side * apart / 2); found.push({ ...p, below: side < 0 });
    }
    return found;
  }

  // which words of a panel keep clear of those before them, on the whole time axis
  function clear_words(panel) {
    const words = panel.traces.filter((t) => t.words), kept = new Set(), room = [];
    if (!words.length) return kept;
    const [low, high] = extent(panel), wide = at("plots").clientWidth - (narrow() ? 60 : 134), tall = inner();
    for (const p of named(panel)) room.push({ x: 7 * p.name.length, y: (p.value - low) / (high - low || 1) * tall + (p.below ? -14 : 0), length: 7 * p.name.length });
    for (const t of words) {
      const x = (t.x[0] - whole[0]) / (whole[1] - whole[0] || 1) * wide, y = (t.y[0] - low) / (high - low || 1) * tall, length = 7 * t.text[0].length + 6;
      if (x < length || room.some((r) => Math.abs(r.y - y) < 13 && x - length < r.x && x > r.x - r.length)) continue;
      room.push({ x, y, length }); kept.add(t);
    }
    return kept;
  }

  function traces(panel) {
    const many = panel.traces.filter((t) => !t.band).length > 60, clear = clear_words(panel);
    return panel.traces.map((t) => {
      if (t.points) return { type: "scatter", mode: "markers", x: t.x, y: t.y, text: t.text, name: t.name, marker: { color: shown(t.color), size: 9, symbol: "diamond" }, hovertemplate: "%{x:g} s: %{y}<br>%{text}<extra></extra>" };
      if (t.words) return { type: "scatter", mode: "text", x: t.x, y: t.y, text: t.text.map((w) => `<b>${safe(w)}</b>`), textfont: { color: shown(t.color), size: 11 }, textposition: "top left", hoverinfo: "skip", visible: drawn_now(t), opacity: clear.has(t) ? 1 : 0 };
      return {
        type: "scatter", mode: t.rings ? "lines+markers" : "lines", x: t.x, y: t.y, name: t.name, connectgaps: false, opacity: t.alpha || 1, visible: drawn_now(t),
        line: { color: shown(t.color), width: t.fill === "self" ? 0.5 : t.band ? 0 : many ? 0.8 : 1.6, dash: t.dash || "solid", shape: t.step ? "hv" : "linear" },
        ...(t.rings ? { marker: { symbol: "circle-open", size: 7, color: shown(t.color) } } : {}),
        fill: t.fill === "self" ? "toself" : t.fill ? "tonexty" : "none", fillcolor: t.fill ? faint(t.color) : undefined,
        hoverinfo: t.band ? "skip" : undefined, hovertemplate: t.band ? undefined : "<b>%{fullData.name}</b><br>%{y:.5~g} at %{x:.6~g} s<extra></extra>",
      };
    });
  }

  function ticks(span) { // of an axis in hours and minutes
    const steps = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400], most = narrow() ? 4 : 9;
    const step = steps.find((s) => (span[1] - span[0]) / s <= most) || 86400, at_ = [];
    for (let t = Math.ceil(span[0] / step) * step; t <= span[1]; t += step) at_.push(t);
    return { tickvals: at_, ticktext: at_.map((t) => step < 60 ? when(t) : when(t).slice(0, 5)) };
  }

  function layout(panel) {
    const grid = css("--line"), soft = css("--soft"), small = narrow();
    const bounds = panel.bounds || [], places = panel.places || [];
    const axis = { gridcolor: grid, zerolinecolor: grid, linecolor: soft, tickcolor: soft };
    const y = { ...axis, title: { text: small ? undefined : panel.unit, standoff: 8 }, exponentformat: "power" };
    if (panel.log) Object.assign(y, { type: "log", range: panel.log });
    if (panel.categories) Object.assign(y, { type: "category", title: undefined, tickfont: { size: 10, color: css("--ink") }, ticklabelposition: small ? "inside" : "outside" });
    const place_colour = (p) => p.stop ? css("--ink") : soft;
    return {
      // the margins are the same in all plots, so that one moment stands in one column; the tools have a row of their own above
      height: panel.categories ? 76 + 26 * panel.traces.length : small ? 290 : 326, margin: { l: small ? 46 : 120, r: 14, t: small ? 38 : 32, b: 40 }, modebar: { bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: css("--accent") }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: css("--ink"), size: small ? 10 : 12, family: "system-ui, DejaVu Sans, sans-serif" }, hovermode: "closest", hoverdistance: -1,
      hoverlabel: { bgcolor: css("--paper"), bordercolor: grid, font: { color: css("--ink") }, align: "left" },
      showlegend: false, xaxis: { ...axis, title: { text: data.clock ? "time [h:min]" : "time [s]", standoff: 4 }, range: range.slice(), ...(data.clock ? ticks(range) : {}) }, yaxis: y, dragmode: small ? false : "zoom",
      shapes: [...bounds.filter((b) => !b.far).map((b) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: b.value, y1: b.value, line: { color: b.dash === "dot" ? css("--ink") : css("--bad"), width: 1.2, dash: b.dash } })),
        ...places.map((p) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: p.value, y1: p.value, layer: "below", line: { color: place_colour(p), width: p.stop ? 1 : 0.8, dash: p.stop ? "solid" : "dot" } }))],
      annotations: [...bounds.map((b) => ({ xref: "paper", x: 1, xanchor: "right", showarrow: false, ...(b.far ? { yref: "paper", y: b.far > 0 ? 1 : 0, yanchor: b.far > 0 ? "top" : "bottom" } : { y: panel.log ? Math.log10(b.value) : b.value, yanchor: "bottom" }), text: `${b.far ? (b.far > 0 ? "↑ " : "↓ ") : ""}${b.name} ${+b.value.toPrecision(4)}`, font: { size: 10, color: b.dash === "dot" ? css("--ink") : css("--bad") } })),
        ...named(panel).map((p) => ({ xref: "paper", x: 0, xanchor: "left", y: p.value, yanchor: p.below ? "top" : "bottom", showarrow: false, text: p.stop ? `<b>${safe(p.name)}</b>` : safe(p.name), font: { size: 10, color: place_colour(p) } }))],
    };
  }
  const safe = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");

  // plotly leaves shapes out of the automatic range: unseen points at the bounds, and at stops that no train reached, bring them in
  function anchors(panel) {
    const values = (panel.bounds || []).filter((b) => !b.far).map((b) => b.value);
    values.push(...(panel.places || []).filter((p) => p.unreached).map((p) => p.value));
    if (panel.least_range && !values.length) values.push(-panel.least_range / 2, panel.least_range / 2);
    return values.length ? [{ type: "scatter", mode: "markers", x: values.map(() => whole[0]), y: values, marker: { opacity: 0, size: 1 }, hoverinfo: "skip", showlegend: false }] : [];
  }

  const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg" } };
  for (const panel of data.panels) {
    const box = document.createElement("figure");
    box.className = "plot"; box.id = "plot-" + panel.id; box.tabIndex = 0; box.setAttribute("role", "group"); box.setAttribute("aria-label", panel.title + ", " + panel.unit);
    box.style.marginLeft = box.style.marginRight = 0;
    const head = document.createElement("figcaption"), title = document.createElement("h3"), note = document.createElement("span");
    title.textContent = panel.title;
    if (panel.unit) { // where there is no room for it at the axis
      const unit = document.createElement("span"); unit.className = "unit"; unit.textContent = `, ${panel.unit}`; title.append(unit);
    }
    note.className = "about"; note.textContent = panel.note || "";
    head.append(title, note);
    const draw = document.createElement("div"); draw.className = "draw";
    const cursor = document.createElement("div"); cursor.className = "cursor";
    box.append(head, draw, cursor);
    at("plots").append(box);
    plots.push({ panel, box, draw, cursor });
    box.addEventListener("keydown", (event) => keys(event));
  }

  let drawn = 0;
  function redraw() { return Promise.all(plots.map((p) => Plotly.react(p.draw, [...traces(p.panel), ...anchors(p.panel)], layout(p.panel), options))); }
  function draw_next() { // one plot per turn, so that the page answers while the rest is drawn
    if (drawn === plots.length) { document.documentElement.dataset.ready = "yes"; cursors(); return; }
    const p = plots[drawn++];
    Plotly.newPlot(p.draw, [...traces(p.panel), ...anchors(p.panel)], layout(p.panel), options).then(() => {
      p.draw.on("plotly_relayout", (change) => linked(p, change));
      p.draw.on("plotly_click", (hit) => { if (hit.points.length) go_to_time(hit.points[0].x); });
      setTimeout(draw_next, 0);
    });
  }

  let busy = false;
  function linked(source, change) {
    if (busy) return;
    if (change["xaxis.autorange"]) show_times(whole);
    else if ("xaxis.range[0]" in change) show_times([change["xaxis.range[0]"], change["xaxis.range[1]"]]);
    else if (change["xaxis.range"]) show_times(change["xaxis.range"]);
    else cursors();
  }
  async function show_times(wanted) {
    const span = whole[1] - whole[0] || 1;
    const low = Math.max(wanted[0], whole[0] - 0.02 * span), high = Math.min(wanted[1], whole[1] + 0.02 * span);
    range = high > low ? [low, high] : whole.slice();
    busy = true;
    await Promise.all(plots.slice(0, drawn).map((p) => Plotly.relayout(p.draw, { "xaxis.range": range.slice(), ...(data.clock ? { "xaxis.tickvals": ticks(range).tickvals, "xaxis.ticktext": ticks(range).ticktext } : {}) })));
    busy = false;
    cursors();
  }
  function keys(event) {
    const span = range[1] - range[0], middle = (range[0] + range[1]) / 2;
    const wanted = { "+": [middle - span / 4, middle + span / 4], "=": [middle - span / 4, middle + span / 4], "-": [middle - span, middle + span], "0": whole,
      ArrowLeft: [range[0] - span / 5, range[1] - span / 5], ArrowRight: [range[0] + span / 5, range[1] + span / 5] }[event.key];
    if (wanted && !event.ctrlKey && !event.metaKey) { event.preventDefault(); event.stopPropagation(); show_times(wanted); }
  }
  at("all").addEventListener("click", () => show_times(whole));

  // ---- one legend of trains for all plots -----------------------------------------------------------------------------------------
  const natural = new Intl.Collator("en", { numeric: true }).compare;
  const names = data.animation.trains.map((train) => train.name).sort(natural);
  const chips = new Map();
  function put_on(wanted) { // draw exactly these trains
    for (const name of names) {
      if (wanted.has(name)) hidden.delete(name); else hidden.add(name);
      chips.get(name).setAttribute("aria-pressed", String(wanted.has(name)));
    }
    if (filmed) paint_mini(0);
    for (const p of plots.slice(0, drawn)) Plotly.restyle(p.draw, { visible: p.panel.traces.map(drawn_now) }, p.panel.traces.map((_, k) => k));
  }
  for (const name of names) {
    const chip = document.createElement("button"), swatch = document.createElement("i");
    chip.type = "button"; chip.className = "chip"; chip.dataset.train = name; chip.setAttribute("aria-pressed", "true");
    swatch.dataset.color = data.animation.trains.find((train) => train.name === name).color;
    chip.append(swatch, name);
    const left = () => new Set(names.filter((n) => !hidden.has(n)));
    chip.addEventListener("click", (event) => {
      const now_on = left();
      if (event.shiftKey) { put_on(new Set([name])); return; }
      if (now_on.has(name)) now_on.delete(name); else now_on.add(name);
      put_on(now_on);
    });
    chip.addEventListener("dblclick", () => put_on(new Set([name])));
    chips.set(name, chip);
    at("trains").append(chip);
  }
  at("everybody").addEventListener("click", () => put_on(new Set(names)));
  function swatches() { document.querySelectorAll(".chip i, .swatch").forEach((i) => { i.style.background = shown(i.dataset.color); }); }

  function cursors() {
    for (const p of plots.slice(0, drawn)) {
      const full = p.draw._fullLayout, x = full && full.xaxis;
      if (!x || !x._length) continue;
      const share = (now - x.range[0]) / (x.range[1] - x.range[0]), inside = share >= 0 && share <= 1;
      p.cursor.style.display = inside ? "block" : "none";
      p.cursor.style.left = p.draw.offsetLeft + x._offset + share * x._length + "px";
      p.cursor.style.top = p.draw.offsetTop + full.yaxis._offset + "px";
      p.cursor.style.height = full.yaxis._length + "px";
    }
  }

  // ---- tracks ------------------------------------------------------------------------------------------------------------------
  const film = data.animation, times = film.time, count = film.trains.length, couples = film.pairs.length;
  const filmed = times.length > 0, none = { bdata: "" };
  const position = floats(film.position || none), lateral = floats(film.lateral || none), speed = floats(film.speed || none), links = bytes(film.links);
  const map = film.map ? film.map.map(floats) : null, edges_of = film.edge ? floats(film.edge) : null;
  const canvas = at("view"), pen = canvas.getContext("2d"), slider = at("slider");
  function flatness([east, north]) { // how far a net goes from south to north, over how far from west to east
    const span = (values) => { let low = Infinity, high = -Infinity; for (const v of values) { if (v < low) low = v; if (v > high) high = v; } return high - low; };
    return span(north) / Math.max(span(east), 1);
  }
  let frame = 0, now = whole[0], playing = false, last = 0;
  const height = map ? Math.round(Math.min(460, Math.max(180, 120 + 8000 * flatness(map)))) : 72 + 46 * Math.max(film.tracks.length, 1);
  slider.max = times.length - 1;
  film.trains.forEach((train, k) => at("follow").add(new Option("train " + train.name, k)));

  // the stretch shown is as long as the longest the trains ever took, so that nothing jumps while playing
  let reach = 1000;
  for (let f = 0; f < times.length; f++) {
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < count; k++) { const x = position[f * count + k]; if (x < low) low = x; if (x > high) high = x; }
    if (high - low > reach) reach = high - low;
  }
  reach *= 1.12;

  function place(k, share) { // of train k between this frame and the next
    const a = frame * count + k, b = a + count;
    if (Number.isNaN(position[a])) return null;
    const blend = (from) => share > 0 && frame + 1 < times.length && !Number.isNaN(position[b]) ? from[a] + share * (from[b] - from[a]) : from[a];
    return { x: blend(position), side: blend(lateral), v: speed[a] };
  }

  // words are left out where they would lie on others
  let taken = [], brink = 0; // what is written, and where the picture begins
  function write(text, x, y) {
    const width = pen.measureText(text).width, edge = canvas.clientWidth - 4;
    if (pen.textAlign === "left" && x < edge) x = Math.min(x, edge - width);
    const left = x - (pen.textAlign === "center" ? width / 2 : 0);
    if (left < brink || taken.some(([l, r, at]) => left < r + 3 && left + width > l - 3 && Math.abs(at - y) < 12)) return false;
    taken.push([left, left + width, y]);
    pen.save(); pen.setLineDash([]); pen.lineJoin = "round"; pen.lineWidth = 3; pen.strokeStyle = css("--panel"); pen.strokeText(text, x, y); pen.restore(); // a rim, so that lines do not cross it
    pen.fillText(text, x, y);
    return true;
  }
  // of a crowd these trains have numbers: the first and the last by place, and about ten between them
  const numbers_of = (here) => {
    const order = here.map((p, k) => k).filter((k) => here[k]).sort((a, b) => here[b].x - here[a].x), stride = Math.ceil(order.length / 12);
    return new Set(count <= 30 ? order : order.filter((_, i) => i % stride === 0 || i === order.length - 1));
  };

  // a net of any shape: true to scale, unless it is so long and flat that nothing could be told apart
  const box = map ? [0, 1].map((d) => { let low = Infinity, high = -Infinity; for (const v of map[d]) { if (v < low) low = v; if (v > high) high = v; } return [low, high]; }) : null;
  function paint_map(share, width) {
    const here = film.trains.map((_, k) => place(k, share)), numbered = numbers_of(here), chosen = +at("follow").value, zoom = Math.pow(2, +at("zoom").value);
    const spans = box.map(([low, high]) => Math.max(high - low, 100)), margin = 60;
    const across = (width - 2 * margin) / spans[0], up = (height - 2 * margin) / spans[1];
    const base = Math.min(across, up), raised = spans[1] > 100 && Math.min(up, 8 * across) > base * 1.5 ? Math.min(up, 8 * across) / base : 1;
    const sx = zoom * base, sy = zoom * base * raised;
    const mid = chosen >= 0 && here[chosen] ? [here[chosen].x, here[chosen].side] : box.map(([low, high]) => (low + high) / 2);
    const px = (x) => width / 2 + sx * (x - mid[0]), py = (y) => height / 2 - sy * (y - mid[1]);
    pen.font = "12px system-ui, DejaVu Sans, sans-serif"; pen.textBaseline = "middle"; pen.lineJoin = "round";
    pen.strokeStyle = css("--track"); pen.lineWidth = 2; pen.beginPath();
    for (let k = 0, move = true; k < map[0].length; k++) {
      if (Number.isNaN(map[0][k])) { move = true; continue; }
      if (move) pen.moveTo(px(map[0][k]), py(map[1][k])); else pen.lineTo(px(map[0][k]), py(map[1][k]));
      move = false;
    }
    pen.stroke();
    pen.font = "12px system-ui, DejaVu Sans, sans-serif"; pen.textAlign = "left"; pen.strokeStyle = css("--ink"); pen.lineWidth = 1.5;
    for (const stop of film.stops || []) { // squares across the track: filled where a train came
      const x = px(stop.x), y = py(stop.y);
      pen.fillStyle = css(stop.reached ? "--ink" : "--panel"); pen.beginPath(); pen.rect(x - 4, y - 4, 8, 8); pen.fill(); pen.stroke();
    }
    pen.strokeStyle = css("--accent");
    for (let c = 0; c < couples; c++) {
      const state = links[frame * couples + c], a = here[film.pairs[c][0]], b = here[film.pairs[c][1]];
      if (!state || !a || !b) continue;
      const ax = px(a.x), ay = py(a.side), bx = px(b.x), by = py(b.side), rise = Math.min(30, 6 + Math.hypot(ax - bx, ay - by) / 6);
      pen.lineWidth = 1.6; pen.setLineDash(state === 2 ? [] : [4, 4]);
      pen.beginPath(); pen.moveTo(ax, ay); pen.quadraticCurveTo((ax + bx) / 2, (ay + by) / 2 - rise, bx, by); pen.stroke(); pen.setLineDash([]);
    }
    here.forEach((p, k) => {
      if (!p) return;
      const x = px(p.x), y = py(p.side);
      pen.fillStyle = shown(film.trains[k].color); pen.strokeStyle = css("--panel"); pen.lineWidth = 1.5;
      pen.beginPath(); pen.arc(x, y, 7, 0, 7); pen.fill(); pen.stroke();
      if (zoom > 4 || numbered.has(k)) {
        pen.fillStyle = css("--ink"); pen.font = "bold 12px system-ui, DejaVu Sans, sans-serif"; pen.textAlign = "left"; [k % 2 ? 14 : -12, k % 2 ? -12 : 14].some((d) => write(film.trains[k].name, x + 9, y + d));
      }
    });
    pen.font = "12px system-ui, DejaVu Sans, sans-serif"; // stops are named where the trains leave room
    for (const stop of film.stops || []) {
      const x = px(stop.x), y = py(stop.y), words = stop.name + (stop.reached ? "" : narrow() ? " (none came)" : " (no train came)");
      pen.fillStyle = css(stop.reached ? "--ink" : "--soft");
      if (![14, -14, 28, -28].some((d) => write(words, x + 9, y + d))) write(words, x - 9 - pen.measureText(words).width, y);
    }
    let step = Math.pow(10, Math.floor(Math.log10(width / sx / 4)));
    step *= width / sx / step > 20 ? 5 : width / sx / step > 8 ? 2 : 1;
    const soft = css("--soft"); pen.strokeStyle = soft; pen.fillStyle = soft; pen.lineWidth = 2; pen.textAlign = "left"; pen.font = "12px system-ui, DejaVu Sans, sans-serif";
    pen.beginPath(); pen.moveTo(14, height - 16); pen.lineTo(14 + step * sx, height - 16); pen.stroke();
    pen.fillText((step >= 1000 ? step / 1000 + " km" : step + " m") + (raised <= 1 ? "" : narrow() ? `, northwards × ${raised.toFixed(1)}` : `, northwards drawn ${raised.toFixed(1)} times as large`), 22 + step * sx, height - 16);
    pen.fillStyle = css("--ink"); pen.font = "bold 13px system-ui, DejaVu Sans, sans-serif"; pen.fillText("t = " + when(now), 8, 16);
  }

  // the same in small, beside the legend, in sight while plots are read
  const mini = at("mini"), thin = mini.getContext("2d");
  mini.hidden = !filmed;
  function paint_mini(share) {
    const ratio = devicePixelRatio || 1, width = mini.clientWidth, high = mini.clientHeight;
    if (!width) return;
    mini.width = Math.round(width * ratio); mini.height = Math.round(high * ratio);
    thin.setTransform(ratio, 0, 0, ratio, 0, 0);
    const here = film.trains.map((_, k) => place(k, share)), some = here.filter((p) => p);
    let px, py;
    thin.strokeStyle = css("--track"); thin.lineWidth = 1; thin.beginPath();
    if (map) {
      const [[west, east], [south, north]] = box, scale = Math.min((width - 14) / Math.max(east - west, 100), 1e9), up = Math.min((high - 14) / Math.max(north - south, 100), 8 * scale);
      px = (x) => width / 2 + Math.min(scale, 8 * up) * (x - (west + east) / 2); py = (y) => high / 2 - up * (y - (south + north) / 2);
      for (let k = 0, move = true; k < map[0].length; k++) {
        if (Number.isNaN(map[0][k])) { move = true; continue; }
        if (move) thin.moveTo(px(map[0][k]), py(map[1][k])); else thin.lineTo(px(map[0][k]), py(map[1][k]));
        move = false;
      }
    } else {
      const xs = some.map((p) => p.x), middle = (Math.min(...xs) + Math.max(...xs)) / 2;
      px = (x) => width / 2 + (x - middle) / reach * (width - 14); py = (side) => (side + 0.5) * high / film.tracks.length;
      film.tracks.forEach((_, k) => { thin.moveTo(0, py(k)); thin.lineTo(width, py(k)); });
    }
    thin.stroke();
    here.forEach((p, k) => { if (p && !hidden.has(film.trains[k].name)) { thin.fillStyle = shown(film.trains[k].color); thin.beginPath(); thin.arc(px(p.x), py(p.side), count > 30 ? 2.5 : 4, 0, 7); thin.fill(); } });
  }

  function paint(share) {
    paint_mini(share);
    const ratio = devicePixelRatio || 1, width = canvas.clientWidth;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); canvas.style.height = height + "px";
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    taken = []; brink = 0;
    if (map) { paint_map(share, width); return; }
    const here = film.trains.map((_, k) => place(k, share));
    const present = here.filter((p) => p), numbered = numbers_of(here);
    if (!present.length) return;
    const chosen = +at("follow").value;
    const xs = present.map((p) => p.x);
    const centre = chosen >= 0 && here[chosen] ? here[chosen].x : (Math.min(...xs) + Math.max(...xs)) / 2;
    const span = reach / Math.pow(2, +at("zoom").value), left = 64, room = width - left - 16;
    const px = (x) => left + ((x - centre) / span + 0.5) * room, py = (side) => 62 + 46 * side;
    const ink = css("--ink"), soft = css("--soft"), line = css("--line"), accent = css("--accent");
    pen.font = "12px system-ui, DejaVu Sans, sans-serif"; pen.textBaseline = "middle";

    // kilometrage
    let step = Math.pow(10, Math.floor(Math.log10(span / 5)));
    step *= [0.5, 1, 2, 5, 10].find((times) => span / (times * step) < Math.min(room / 62, 20)) || 20;
    pen.textAlign = "center"; pen.lineWidth = 1;
    for (let x = Math.ceil((centre - span / 2) / step) * step; x < centre + span / 2; x += step) {
      pen.strokeStyle = line; pen.beginPath(); pen.moveTo(px(x), 34); pen.lineTo(px(x), height - 26); pen.stroke();
      const words = +(x / 1000).toFixed(3) + " km";
      if (px(x) + pen.measureText(words).width / 2 < width - 4) { pen.fillStyle = soft; pen.fillText(words, px(x), height - 13); }
    }
    brink = left - 8;
    pen.save(); pen.beginPath(); pen.rect(left - 8, 0, width - 12 - (left - 8), height); pen.clip();
    pen.strokeStyle = css("--track"); pen.lineWidth = 2;
    film.tracks.forEach((_, k) => { pen.beginPath(); pen.moveTo(left, py(k)); pen.lineTo(width - 12, py(k)); pen.stroke(); });
    for (const [a, b, from, to] of film.crossovers) {
      if (px(b) < left || px(a) > width) continue;
      pen.beginPath(); pen.moveTo(px(a), py(from)); pen.lineTo(px(b), py(to)); pen.stroke();
    }

    // links: arcs above the trains; heads of arrows where only one of the two receives
    const mutual = new Map();
    for (let c = 0; c < couples; c++) if (links[frame * couples + c]) mutual.set(film.pairs[c].join(), links[frame * couples + c]);
    for (const [key, state] of mutual) {
      const [sender, receiver] = key.split(",").map(Number), back = mutual.get([receiver, sender].join());
      if (back && sender > receiver) continue;
      const a = here[sender], b = here[receiver];
      if (!a || !b) continue;
      const received = state === 2 && (!back || back === 2);
      pen.strokeStyle = accent; pen.fillStyle = accent; pen.lineWidth = received ? 1.8 : 1.2; pen.setLineDash(received ? [] : [4, 4]);
      const ax = px(a.x), bx = px(b.x), ay = py(a.side) - 9, by = py(b.side) - 9;
      const lift = Math.min(ay, by) - Math.min(34, 8 + Math.abs(ax - bx) / 9);
      pen.beginPath(); pen.moveTo(ax, ay); pen.quadraticCurveTo((ax + bx) / 2, lift, bx, by); pen.stroke(); pen.setLineDash([]);
      if (!back) {
        const angle = Math.atan2(by - lift, bx - (ax + bx) / 2);
        pen.beginPath(); pen.moveTo(bx, by); pen.lineTo(bx - 8 * Math.cos(angle - 0.4), by - 8 * Math.sin(angle - 0.4)); pen.lineTo(bx - 8 * Math.cos(angle + 0.4), by - 8 * Math.sin(angle + 0.4)); pen.fill();
      }
    }

    // trains: bar to scale (at least 8 px), head as a dot, number above and speed below
    here.forEach((p, k) => {
      if (!p) return;
      const train = film.trains[k], x = px(p.x), y = py(p.side), length = Math.max(8, (train.length / span) * room);
      if (x < left - 20 || x - length > width) return;
      pen.fillStyle = shown(train.color); pen.strokeStyle = css("--panel"); pen.lineWidth = 1.5;
      pen.beginPath(); pen.roundRect(x - length, y - 6, length, 12, 3); pen.fill(); pen.stroke();
      pen.beginPath(); pen.arc(x, y, 7, 0, 7); pen.fill(); pen.stroke();
      if (+at("zoom").value > 2 || numbered.has(k)) {
        pen.fillStyle = ink; pen.font = "bold 13px system-ui, DejaVu Sans, sans-serif"; pen.textAlign = "left"; [[10, -9], [-8 - pen.measureText(train.name).width, -9], [-3, -17], [10, 15]].some(([dx, dy]) => write(train.name, x + dx, y + dy));
        pen.font = "11px system-ui, DejaVu Sans, sans-serif"; pen.fillStyle = soft; pen.textAlign = "center"; if (!narrow()) write((data.per_mps * p.v).toFixed(1) + " " + data.speed_unit, x, y + 16);
      }
    });
    pen.restore();
    pen.fillStyle = soft; pen.textAlign = "left"; pen.font = "12px system-ui, DejaVu Sans, sans-serif";
    film.tracks.forEach((name, k) => pen.fillText("track " + name, 8, py(k)));
    pen.fillStyle = ink; pen.font = "bold 13px system-ui, DejaVu Sans, sans-serif"; pen.fillText("t = " + when(now), 8, 16);
    pen.fillStyle = soft; pen.textAlign = "right"; pen.font = "12px system-ui, DejaVu Sans, sans-serif"; pen.fillText("running to the right →", width - 10, 16);
  }

  // the same as a table: one row per train, by number
  const rows = new Map();
  if (filmed) {
    film.trains.map((_, k) => k).sort((a, b) => natural(film.trains[a].name, film.trains[b].name)).forEach((k) => {
      const row = document.createElement("tr"), head = document.createElement("th"), swatch = document.createElement("i");
      row.dataset.train = film.trains[k].name; head.scope = "row"; swatch.dataset.color = film.trains[k].color; swatch.className = "swatch";
      head.append(swatch, film.trains[k].name); row.append(head);
      const cells = ["on", "at", "speed", "received", "lost"].map((name) => { const cell = document.createElement("td"); cell.className = name === "at" || name === "speed" ? "n" : name === "on" ? "" : "names"; row.append(cell); return cell; });
      if (map) cells[1].hidden = true;
      at("rows").append(row); rows.set(k, cells);
    });
    if (map) at("at-km").hidden = true;
    at("speed-unit").textContent = data.speed_unit;
  }
  const put = (cell, text) => { if (cell.textContent !== text) cell.textContent = text; };
  function state_rows() {
    const from = film.trains.map(() => []), lost = film.trains.map(() => []);
    for (let c = 0; c < couples; c++) {
      const state = links[frame * couples + c], [a, b] = film.pairs[c];
      if (state) (state === 2 ? from : lost)[b].push(film.trains[a].name);
    }
    for (const [k, [on, km, fast, received, missing]] of rows) {
      const p = place(k, 0);
      put(on, !p ? "not on the net" : map ? film.tracks[edges_of[frame * count + k]] : Number.isInteger(p.side) ? "track " + film.tracks[p.side] : "crossover to track " + film.tracks[p.side > nearest(k) ? Math.ceil(p.side) : Math.floor(p.side)]);
      put(km, p && !map ? (p.x / 1000).toFixed(3) : "");
      put(fast, p ? (data.per_mps * p.v).toFixed(2) : "");
      put(received, from[k].sort(natural).join(", ")); put(missing, lost[k].sort(natural).join(", "));
    }
    const happened = film.events.filter((e) => Math.abs(e.time - times[frame]) < 1e-6).map((e) => e.kind + (e.text ? " (" + e.text + ")" : ""));
    at("now").textContent = happened.length ? "Now: " + happened.slice(0, 6).join("; ") : "";
  }
  function nearest(k) { // the track train k came from
    for (let f = frame; f >= 0; f--) { const s = lateral[f * count + k]; if (Number.isInteger(s)) return s; }
    return 0;
  }

  function show(wanted) {
    if (!filmed) { cursors(); return; }
    frame = Math.max(0, Math.min(times.length - 1, wanted)); now = times[frame];
    slider.value = frame; slider.setAttribute("aria-valuetext", when(now)); at("clock").textContent = when(now); at("moment").href = "#t=" + +now.toFixed(3);
    paint(0); state_rows(); cursors();
  }
  function frame_of(time) { // the last one not after ``time``
    let low = 0, high = times.length - 1;
    while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= time + 1e-6) low = middle; else high = middle - 1; }
    return low;
  }
  function go_to_time(time) {
    pause();
    if (filmed) show(frame_of(time)); else { now = time; cursors(); }
    history.replaceState(null, "", "#t=" + +time.toFixed(3));
  }
  function tick(stamp) {
    if (!playing) return;
    now += Math.min(stamp - last, 100) / 1000 * +at("rate").value; last = stamp;
    if (now >= whole[1]) { pause(); show(times.length - 1); return; }
    const before = frame; frame = frame_of(now);
    const gap = times[Math.min(frame + 1, times.length - 1)] - times[frame];
    paint(gap > 0 ? Math.max(0, (now - times[frame]) / gap) : 0);
    slider.value = frame; at("clock").textContent = data.clock ? when(now) : now.toFixed(1) + " s";
    if (frame !== before) { state_rows(); cursors(); }
    requestAnimationFrame(tick);
  }
  function pause() { playing = false; at("play").textContent = "Play"; at("play").setAttribute("aria-pressed", "false"); }
  function play() {
    if (frame === times.length - 1) show(0);
    playing = true; at("play").textContent = "Pause"; at("play").setAttribute("aria-pressed", "true"); last = performance.now(); requestAnimationFrame(tick);
  }
  const toggle = () => { if (!filmed) return; if (playing) { pause(); show(frame); } else play(); };
  const moments = [...new Set(film.events.map((e) => e.time))].sort((a, b) => a - b);
  const next_event = (sign) => { const ahead = moments.filter((t) => sign * (t - times[frame]) > 1e-6); if (ahead.length) go_to_time(sign > 0 ? ahead[0] : ahead[ahead.length - 1]); };

  slider.addEventListener("input", () => { pause(); show(+slider.value); });
  at("play").addEventListener("click", toggle);
  at("before").addEventListener("click", () => next_event(-1));
  at("after").addEventListener("click", () => next_event(1));
  at("follow").addEventListener("change", () => paint(0));
  at("zoom").addEventListener("input", () => paint(0));
  document.querySelectorAll("button.link").forEach((b) => b.addEventListener("click", () => { go_to_time(+b.dataset.time); at("tracks").scrollIntoView(); }));
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT", "BUTTON", "TEXTAREA"].includes(event.target.tagName) && !(event.target === slider && event.shiftKey)) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const done = { " ": toggle, ArrowLeft: () => event.shiftKey ? next_event(-1) : (pause(), show(frame - 1)), ArrowRight: () => event.shiftKey ? next_event(1) : (pause(), show(frame + 1)), Home: () => (pause(), show(0)), End: () => (pause(), show(times.length - 1)) }[event.key];
    if (done) { event.preventDefault(); done(); }
  });

  // ---- light and dark, address, start ------------------------------------------------------------------------------------------
  function recolour() { swatches(); if (filmed) paint(0); return redraw().then(cursors); }
  at("theme").addEventListener("click", () => { document.documentElement.dataset.theme = isDark() ? "light" : "dark"; recolour(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  let was_narrow = narrow();
  addEventListener("resize", () => {
    if (filmed) paint(0);
    if (narrow() !== was_narrow) { was_narrow = narrow(); redraw(); }
    setTimeout(cursors, 300);
  });
  const from_address = () => { const wanted = /^#t=([\d.]+)$/.exec(location.hash); if (wanted) go_to_time(+wanted[1]); };
  addEventListener("hashchange", from_address);
  swatches();
  show(0);
  from_address();
  draw_next();
})();
