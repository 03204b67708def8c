// Draws the charts of the report's page, and lets its tables be sorted and filtered.
// Whatever comes from a run is set as text, never as HTML.
"use strict";
(() => {
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const make = (tag, properties, ...inside) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...inside);
    return element;
  };
  const short = (value) => (value === null ? "–" : value.toLocaleString("en", { maximumSignificantDigits: 4 }));
  const FONT = { family: "system-ui, Liberation Sans, sans-serif", size: 13, color: "#1b1f24" };
  const OPTIONS = { responsive: true, displaylogo: false, toImageButtonOptions: { format: "svg" } };
  const layout = (more) => ({
    font: FONT, margin: { l: 64, r: 16, t: 12, b: 48 }, showlegend: false, hovermode: "closest", ...more,
  });
  const axis = (title, more) => ({
    title: { text: plain(title) }, gridcolor: "#e6e9ec", zerolinecolor: "#c8ccd0", automargin: true, ...more,
  });
  const draw = (place, traces, shape) => window.Plotly.react(place, traces, layout(shape), OPTIONS);

  // Okabe's and Ito's colours, for what is chosen; what is not is grey, the baseline dark.
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"], GREY = "#cfd4d9", DARK = "#1b1f24";

  // What was packed into the page, as text: gzip in base64.
  const unpack = async (element) => {
    const bytes = Uint8Array.from(atob(element.textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };

  // ---- Curves: a line and a band for each method, and lines of single seeds.
  const bandOf = (series) => {
    const x = [], y = [];
    for (let i = 0, start = null; i <= series.x.length; i++) {
      const known = i < series.x.length && series.low[i] !== null;
      if (known && start === null) start = i;
      if (known || start === null) continue;
      const part = (values) => values.slice(start, i);
      x.push(...part(series.x), ...part(series.x).reverse(), null);
      y.push(...part(series.high), ...part(series.low).reverse(), null);
      start = null;
    }
    return { x, y };
  };
  const curveTraces = (data, measure, along, colours, seeds) => {
    const grey = [], bands = [], lines = [], single = [];
    data.methods.forEach((method, m) => {
      const series = measure.axes[along][m], color = colours.get(m);
      if (!series) return;
      const name = plain(method.label);
      const look = { type: "scatter", mode: series.x.length < 3 ? "lines+markers" : "lines", name, showlegend: false };
      const line = { color: color ?? GREY, width: color ? 2.4 : 1 };
      const text = series.median.map((median, i) => (series.low[i] === null ? short(median)
        : `${short(median)} [${short(series.low[i])}, ${short(series.high[i])}]`));
      const hover = { text, hovertemplate: `<b>${name}</b><br>%{text}<br>at %{x:,.4~g}<extra></extra>` };
      if (!color) return grey.push({ ...look, x: series.x, y: series.median, line, ...hover, meta: "rest" });
      bands.push({ ...look, ...bandOf(series), mode: "lines", fill: "toself", fillcolor: color,
        line: { width: 0 }, opacity: 0.13, hoverinfo: "skip", meta: "band" });
      const whole = (median, i) => (series.whole[i] ? median : null);
      if (!series.whole.every(Boolean))
        lines.push({ ...look, x: series.x, y: series.median, line: { ...line, width: 0.8 }, ...hover });
      lines.push({ ...look, x: series.x, y: series.median.map(whole), line, ...hover, meta: "median", showlegend: true });
      series.rows.forEach((row, r) => {
        if (!seeds.has(series.seeds[r])) return;
        single.push({ ...look, x: series.x, y: row, connectgaps: true, line: { ...line, width: 1 }, opacity: 0.7, meta: "seed",
          hovertemplate: `<b>${name}</b>, seed ${series.seeds[r]}<br>%{y:.4~g} at %{x:,.4~g}<extra></extra>` });
      });
    });
    return [...grey, ...bands, ...single, ...lines];
  };
  const drawCurves = (place, data, measure, along, colours, seeds) => {
    // As far as the coloured methods go: one that costs nine times as much would squeeze the others.
    const ends = [...colours.keys()].flatMap((m) => measure.axes[along][m]?.x.slice(-1) ?? []);
    const shape = ends.length ? { range: [0, Math.max(...ends)] } : {};
    return draw(place, curveTraces(data, measure, along, colours, seeds), { height: 470, showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
      xaxis: axis(along, shape), yaxis: axis(measure.name, measure.rate ? { rangemode: "tozero" } : {}), uirevision: measure.name + along });
  };

  // ---- Outcomes: the methods in the order of their means, with a dot for each seed.
  const drawOutcomes = (place, data, outcome, colours) => {
    const rank = (m) => (outcome.methods[m].mean.length ? outcome.sign * outcome.methods[m].mean[0] : -Infinity);
    const order = data.methods.map((_, m) => m).sort((a, b) => rank(a) - rank(b));
    const traces = [];
    order.forEach((m, y) => {
      const { mean, values } = outcome.methods[m], { label, seeds } = data.methods[m], color = colours.get(m) ?? "#8c959f";
      const name = plain(label), spread = values.map((_, i) => y - 0.2 + (0.4 * (i + 0.5)) / values.length);
      traces.push({ type: "scatter", mode: "markers", x: values, y: spread, text: seeds.map((s) => `seed ${s}`),
        marker: { color, size: 6, opacity: 0.35 }, hovertemplate: `<b>${name}</b>, %{text}<br>%{x:.4~g}<extra></extra>` });
      if (!mean.length) return;
      traces.push({ type: "scatter", mode: "markers", x: mean, y: [y], name, meta: "mean",
        marker: { color, size: 11, symbol: "diamond" }, hovertemplate: `<b>${name}</b><br>%{x:.4~g}<extra></extra>` });
    });
    const labels = order.map((m) => plain(data.methods[m].label));
    return draw(place, traces, { height: 90 + 27 * order.length, xaxis: axis(outcome.name),
      yaxis: axis("", { tickvals: order.map((_, y) => y), ticktext: labels, range: [-0.6, order.length - 0.4], gridcolor: "#f2f4f6" }) });
  };

  // ---- Through training: proposals, levels and success at one moment.
  const drawStage = (parts, data, found, number) => {
    const stage = found.stages[number], [x, y] = found.curve, [rows, columns] = data.stages.axes.length > 1
      ? data.stages.axes : [null, data.stages.axes[0]];
    const reached = y[x.filter((updates) => updates <= stage.updates).length - 1] ?? null;
    parts.levels.parentElement.hidden = !found.stages.some((each) => each.levels.length);
    parts.moment.textContent = `update ${stage.updates}: ${short(reached)}`;
    parts.levels.replaceChildren(...stage.levels.map((level, i) => {
      const name = `number ${i + 1} of the batch at update ${stage.updates}`;
      if (typeof level === "number")
        return make("img", { src: `data:image/png;base64,${data.stages.pictures[level]}`, alt: name, title: name });
      return make("pre", { title: name }, level.join("\n"));
    }));
    draw(parts.success, [
      { type: "scatter", mode: "lines", x, y, line: { color: COLOURS[0], width: 2 }, hovertemplate: "%{y:.4~g} at update %{x}<extra></extra>" },
      { type: "scatter", mode: "markers", x: [stage.updates], y: [reached], marker: { color: COLOURS[0], size: 12 }, hoverinfo: "skip", meta: "now" },
    ], { height: 300, xaxis: axis(data.axes[0]), yaxis: axis(data.headline.name, data.headline.rate ? { range: [-0.02, 1.02] } : {}),
      shapes: [{ type: "line", x0: stage.updates, x1: stage.updates, yref: "paper", y0: 0, y1: 1, line: { color: "#8c959f", dash: "dot", width: 1 } }] });
    const maps = found.stages.map((each) => each.map).filter(Boolean);
    parts.mapPart.hidden = !maps.length;
    parts.noMap.hidden = Boolean(maps.length);
    if (!maps.length) return;
    const even = 1 / maps[0].flat().length, largest = Math.max(2 * even, ...maps.flat(2));
    const ticks = (side) => ({ tickvals: side ? side.values.map((_, i) => i) : [], ticktext: side ? side.values.map(String) : [] });
    draw(parts.map, [{ type: "heatmap", z: stage.map, zmin: 0, zmax: largest, xgap: 2, ygap: 2,
      colorscale: [[0, "#542788"], [even / largest, "#f7f7f7"], [1, "#b35806"]], colorbar: { tickformat: ".0%", thickness: 12 },
      hovertemplate: "%{z:.2%} of the proposals<extra></extra>" }],
    { height: 300, xaxis: axis(columns.name, ticks(columns)), yaxis: axis(rows ? rows.name : "", ticks(rows)) });
  };

  // ---- Methods beside the baseline: what is ticked is compared, and p is corrected for that alone.
  const ERROR = 0.05;
  const holm = (every) => {
    const order = every.map((_, i) => i).sort((a, b) => every[a] - every[b]), found = [];
    order.forEach((i, rank) => { found[i] = Math.max(found[order[rank - 1]] ?? 0, Math.min(1, every[i] * (every.length - rank))); });
    return found;
  };
  const written = (p) => (p < 0.001 ? "< 0.001" : String(Number(p.toPrecision(2))));
  const against = (table) => {
    const rows = [...table.tBodies[0].rows], verdict = 3;
    const answer = table.closest("section").querySelector(".answer"), whole = [...answer.children];
    const chosen = () => rows.filter((row) => row.querySelector("input")?.checked);
    const tell = () => {
      const own = chosen(), asked = own.length ? own : rows, tested = asked.filter((row) => row.dataset.alone);
      const corrected = holm(tested.map((row) => Number(row.dataset.alone)));
      for (const row of rows) {
        const p = corrected[tested.indexOf(row)], { kind, alone } = row.dataset;
        row.dataset.now = p <= ERROR ? kind : "";
        row.cells[verdict].textContent = !asked.includes(row) || !kind ? "–" : p === undefined ? kind
          : p > ERROR && alone <= ERROR ? `undecided: p ${written(p)} in ${tested.length} tests, ${written(Number(alone))} alone`
            : `${p > ERROR ? "undecided" : kind}, p ${written(p)}`;
      }
      const said = own.map((row) => make("p", {}, `${row.dataset.says}, ${row.cells[verdict].textContent}.`));
      answer.replaceChildren(...(said.length ? said.slice(0, 3) : whole));
    };
    // The methods in colour, by their numbers: the baseline, and what is ticked or else the first.
    const colours = () => {
      const own = chosen(), shown = own.length ? own : rows.filter((row) => row.dataset.kind).slice(0, 1);
      const found = new Map(shown.map((row, i) => [row, COLOURS[i % COLOURS.length]]));
      for (const row of rows) {
        if (!row.dataset.kind) found.set(row, DARK);
        row.querySelector("i").style.background = found.get(row) ?? "none";
      }
      return new Map([...found].map(([row, colour]) => [Number(row.dataset.number), colour]));
    };
    table.addEventListener("change", tell);
    return colours;
  };

  // ---- One study: its controls and charts.
  const checked = (boxes) => new Set(boxes.filter((box) => box.checked).map((box) => Number(box.value)));
  const study = async (section) => {
    const data = JSON.parse(await unpack(section.querySelector(".data")));
    const one = (name) => section.querySelector(`.${name}`);
    const option = (text, value) => make("option", { textContent: text, value });
    const seeds = [...new Set(data.methods.flatMap((method) => method.seeds))].sort((a, b) => a - b);
    one("seeds").append(...seeds.map((seed) => make("label", {}, make("input", { type: "checkbox", value: seed }), ` ${seed}`)));
    const boxes = (name) => [...one(name).querySelectorAll("input")];
    const kinds = [...new Set(data.measures.map((measure) => measure.kind))];
    one("measure").append(...kinds.map((kind) => make("optgroup", { label: kind },
      ...data.measures.flatMap((measure, i) => (measure.kind === kind ? [option(measure.name, i)] : [])))));
    one("outcome").append(...data.outcomes.map((outcome, i) => option(outcome.name, i)));
    const table = section.querySelector(".against"), colours = against(table);
    let along = data.axes[0];
    const redraw = () => {
      const measure = data.measures[Number(one("measure").value)], possible = Object.keys(measure.axes);
      const shown = possible.includes(along) ? along : possible[0];
      one("axes").replaceChildren(...[...new Set([...data.axes, shown])].map((name) => {
        const button = make("button", { type: "button", textContent: name, disabled: !possible.includes(name) });
        button.setAttribute("aria-pressed", name === shown);
        button.addEventListener("click", () => { along = name; redraw(); });
        return button;
      }));
      drawCurves(one("curves"), data, measure, shown, colours(), checked(boxes("seeds")));
      drawOutcomes(one("outcomes"), data, data.outcomes[Number(one("outcome").value)], colours());
    };
    one("seeds").addEventListener("click", (event) => {
      if (!event.target.dataset.all) return;
      boxes("seeds").forEach((box) => { box.checked = event.target.dataset.all === "1"; });
      redraw();
    });
    for (const each of [table, ...["seeds", "measure", "outcome"].map(one)]) each.addEventListener("change", redraw);
    redraw();
    if (one("through")) through(one, data, option);
  };
  const through = (one, data, option) => {
    const range = one("moment-slider"), choice = one("staged");
    data.stages.methods.forEach((found, m) => found && choice.append(option(`${data.methods[m].label}, seed ${found.seed}`, m)));
    choice.value = String(data.stages.first);
    const show = () => {
      const found = data.stages.methods[Number(choice.value)];
      range.max = found.stages.length - 1;
      const parts = Object.fromEntries(["moment", "levels", "success", "map"].map((name) => [name, one(name)]));
      drawStage({ ...parts, mapPart: one("map-part"), noMap: one("no-map") },
        data, found, Number(range.value));
      range.setAttribute("aria-valuetext", parts.moment.textContent);
    };
    let timer = null;
    const stop = () => { clearInterval(timer); timer = null; one("play").textContent = "Play"; };
    one("play").addEventListener("click", () => {
      if (timer) return stop();
      if (range.value === range.max) range.value = 0;
      one("play").textContent = "Stop";
      timer = setInterval(() => { range.value = Number(range.value) + 1; show(); if (range.value === range.max) stop(); }, 500);
    });
    choice.addEventListener("change", show);
    range.addEventListener("input", show);
    show();
  };

  // ---- Tables: a button in each head sorts, a field filters.
  const numeric = (text) => parseFloat(text.replace(/,/g, "").replace("−", "-"));
  const compare = (a, b) => {
    const [x, y] = [numeric(a), numeric(b)];
    if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) && Number.isNaN(y) ? a.localeCompare(b) : Number.isNaN(x) - Number.isNaN(y);
    return x - y;
  };
  const sortable = (table) => {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const text = (row, column) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    heads.forEach((head, column) => {
      const button = make("button", { type: "button" }, ...head.childNodes);
      head.replaceChildren(button);
      button.addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") !== "ascending";
        heads.forEach((each) => each.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        const empty = (row) => text(row, column) === "–";
        body.append(...[...body.rows].sort((a, b) => empty(a) - empty(b)
          || (up ? 1 : -1) * compare(text(a, column), text(b, column))));
      });
    });
    if (body.rows.length < 6 || table.className === "against") return;
    const count = make("span", { className: "dim" }), field = make("input", { type: "search", placeholder: "Filter rows" });
    field.setAttribute("aria-label", "Filter rows");
    count.setAttribute("aria-live", "polite");
    field.addEventListener("input", () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      let left = 0;
      for (const row of body.rows) {
        row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
        left += !row.hidden;
      }
      count.textContent = ` ${left} of ${body.rows.length} rows`;
    });
    table.parentElement.before(make("p", { className: "filter" }, field, count));
  };

  document.querySelectorAll("table").forEach(sortable);
  const start = async () => {
    const script = make("script", { textContent: await unpack(document.getElementById("plotly")) });
    document.head.append(script);
    document.documentElement.classList.add("live-page");
    document.querySelectorAll("#arena .against").forEach((table) => against(table));
    for (const section of document.querySelectorAll("section.study")) await study(section);
    document.documentElement.dataset.ready = "1";
  };
  // A browser that cannot do this shows tables, and where the figures are.
  start().catch(() => document.documentElement.classList.remove("live-page"));
})();
