// The maze explorer: what a run knows and replays in every state, over training.
"use strict";

(() => {
  const { mazes, runs, steps } = data.explorer;
  const at = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const DIVERGING = [[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]];
  const MOVES = { E: [1, 0, "east"], N: [0, -1, "north"], S: [0, 1, "south"], W: [-1, 0, "west"] };
  const ORACLE = "points of the oracle";
  let chosen = null; // the number of the state that is told of
  let playing = null;

  const name = (sampler) => (data.samplers[sampler] || { name: sampler }).name;
  const mix = (stops, share) => {
    const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const low = Math.min(Math.floor(place), stops.length - 2);
    const parts = stops[low].map((part, i) => part + (stops[low + 1][i] - part) * (place - low));
    return `rgb(${parts.map(Math.round).join(",")})`;
  };
  const number = (value) => (value === null || value === undefined ? "none" : value.toPrecision(3));

  // What is chosen now.
  const now = () => {
    const maze = Number(at("maze").value);
    const find = (sampler) => runs.find((run) => run.maze === maze && run.sampler === sampler);
    const beside = at("beside").value;
    return {
      maze: mazes[maze],
      run: find(at("sampler").value),
      seed: Number(at("seed").value),
      step: Number(at("step").value),
      quantity: at("quantity").value,
      beside: beside === ORACLE ? null : find(beside),
    };
  };

  // Ranks from 0 to 1 of the known values; equal values share their mean rank.
  const ranks = (values, known) => {
    const places = values.map((_, i) => i).filter((i) => known(i)).sort((a, b) => values[a] - values[b]);
    const found = values.map(() => null);
    for (let i = 0; i < places.length; ) {
      let end = i;
      while (end < places.length && values[places[end]] === values[places[i]]) end += 1;
      const rank = (i + end - 1) / 2 / Math.max(places.length - 1, 1);
      for (; i < end; i += 1) found[places[i]] = rank;
    }
    return found;
  };

  // For one run: the share of the scale for each state (null: hatched), and the scale's ends.
  const shares = (run, seed, step, quantity, maze) => {
    const seen = run.visited[seed][step];
    const known = (i) => seen[i] === "1" && !maze.terminal[i];
    const values = run[quantity][seed][step];
    if (values === null) return { shares: maze.terminal.map(() => null), ends: null };
    if (quantity === "p") {
      return { shares: ranks(values, known), ends: ["lowest p", "highest p"], stops: VIRIDIS };
    }
    const visible = values.map((value, i) => (known(i) ? value : null));
    if (quantity === "relative") {
      // From a quarter of the draws of uniform replay to four times as many.
      const share = (value) => (value === null ? null : value > 0 ? Math.log2(value) / 4 + 0.5 : 0);
      return { shares: visible.map(share), ends: ["1/4", "4 times"], stops: DIVERGING };
    }
    // One scale for all steps, so that colours can be compared while the slider moves.
    const all = run[quantity][seed].flatMap((one, k) =>
      one.filter((value, i) => value !== null && run.visited[seed][k][i] === "1")
    );
    const [low, high] = [Math.min(...all), Math.max(...all)];
    const share = (value) => (value === null ? null : high > low ? (value - low) / (high - low) : 0.5);
    return { shares: visible.map(share), ends: [number(low), number(high)], stops: VIRIDIS };
  };

  const element = (tag, attributes) => {
    const made = document.createElementNS(SVG, tag);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };

  // The parts of a maze that stay: states, walls, dots of decision points, S and T.
  const build = (svg, maze) => {
    svg.setAttribute("viewBox", `-0.6 -0.6 ${maze.columns + 0.2} ${maze.rows + 0.2}`);
    const places = maze.shape.map((d, i) => {
      const place = element("path", { d, class: "place", "data-state": i });
      if (maze.terminal[i]) place.setAttribute("visibility", "hidden");
      return place;
    });
    const dots = maze.decision
      .map((is, i) => (is ? maze.anchor[i] : null))
      .filter(Boolean)
      .map(([x, y]) => element("circle", { cx: x, cy: y, r: 0.07, class: "dot" }));
    const letters = [["S", maze.start], ["T", maze.goal]].map(([text, [x, y]]) => {
      const letter = element("text", { x, y, class: "letter" });
      letter.textContent = text;
      return letter;
    });
    const moves = element("g", {});
    const outline = element("path", { class: "chosen" });
    const walls = element("path", { d: maze.walls, class: "wall" });
    const onTop = places[maze.last_move.indexOf("start")]; // the disc lies over its cell
    svg.replaceChildren(...places.filter((place) => place !== onTop), onTop, walls, ...dots, moves, outline, ...letters);
    return { maze, places, moves, outline };
  };
  const views = { left: null, right: null };

  // The greedy policy: its way from S, and its move at every decision point that was visited.
  const moves = (maze, heading, seen) => {
    const key = (column, row, move) => `${column} ${row} ${move}`;
    const states = new Map(maze.column.map((c, i) => [key(c, maze.row[i], maze.last_move[i]), i]));
    const line = [];
    const passed = new Set();
    let state = maze.last_move.indexOf("start");
    while (state !== undefined && !passed.has(state)) {
      passed.add(state);
      line.push(`${maze.column[state]} ${maze.row[state]}`);
      if (maze.terminal[state]) break;
      const [dx, dy, move] = MOVES[heading[state]];
      state = states.get(key(maze.column[state] + dx, maze.row[state] + dy, move));
    }
    const way = element("path", { d: `M${line.join("L")}`, class: "way" });
    const arrows = maze.decision.flatMap((is, i) => {
      if (!is || seen[i] !== "1") return [];
      const [dx, dy] = MOVES[heading[i]];
      const [x, y] = maze.anchor[i];
      const turn = (Math.atan2(dy, dx) * 180) / Math.PI;
      const best = maze.best[i].includes(heading[i]);
      return [element("path", {
        d: "M0.2 0L-0.06 0.11L-0.06 0.045L-0.16 0.045L-0.16 -0.045L-0.06 -0.045L-0.06 -0.11Z",
        transform: `translate(${x} ${y}) rotate(${turn})`,
        class: best ? "arrow" : "arrow wrong",
      })];
    });
    return { drawn: [way, ...arrows], reaches: maze.terminal[state] === 1 };
  };

  // `run` is null where the oracle's points are shown, which have no policy.
  const paint = (side, maze, shown, run, seed, step) => {
    if (!views[side] || views[side].maze !== maze) views[side] = build(at(side), maze);
    const view = views[side];
    view.places.forEach((place, i) => {
      const share = shown.shares[i];
      place.setAttribute("fill", share === null ? "url(#hatch)" : mix(shown.stops, share));
    });
    const arrows = run && at("arrows").checked;
    const policy = arrows ? moves(maze, run.heading[seed][step], run.visited[seed][step]).drawn : [];
    view.moves.replaceChildren(...policy);
    const bar = document.createElement("i");
    if (shown.ends) {
      bar.style.background = `linear-gradient(to right, ${shown.stops.map((s) => `rgb(${s})`).join(",")})`;
      at(`${side}-scale`).replaceChildren(shown.ends[0], bar, shown.ends[1]);
    } else {
      at(`${side}-scale`).replaceChildren("This sampler has no criterion.");
    }
  };

  const title = (run, seed, step, maze, quantity) => {
    const auc = run.auc[seed][step];
    const [heading, seen] = [run.heading[seed][step], run.visited[seed][step]];
    const met = [...maze.decision.keys()].filter((i) => maze.decision[i] && seen[i] === "1");
    const wrong = met.filter((i) => !maze.best[i].includes(heading[i]));
    const knows = quantity === "p" && auc !== null ? ` ROC AUC for decision points ${auc.toFixed(2)}.` : "";
    const reaches = moves(maze, heading, seen).reaches ? "reaches T" : "does not reach T";
    return `${name(run.sampler)}.${knows} The greedy policy ${reaches}, and is wrong at ${wrong.length} of the ${met.length} decision points that were visited.`;
  };

  const tell = ({ maze, run, seed, step }) => {
    for (const view of Object.values(views)) {
      view.outline.setAttribute("d", chosen === null ? "" : maze.shape[chosen]);
    }
    if (chosen === null) {
      at("state").textContent = "Point at a state, or tap it, to read its numbers.";
      return;
    }
    const i = chosen;
    const of = (quantity) => (run[quantity][seed][step] ? run[quantity][seed][step][i] : null);
    const seen = run.visited[seed][step][i] === "1";
    const arrival = maze.last_move[i] === "start" ? "the start" : `after a move ${maze.last_move[i]}`;
    const parts = [
      `Cell ${maze.column[i]}, ${maze.row[i]} from the upper left, ${arrival}${maze.decision[i] ? ", a decision point" : ""}${seen ? "" : ", not visited yet"}`,
      `value ${number(of("value"))}`,
      `p ${number(of("p"))}`,
      `${of("draws")} draws since the step before, ${number(of("relative"))} times as many as under uniform replay`,
      `mean unroll ${number(of("unroll"))} steps`,
      `greedy move ${run.heading[seed][step][i]}, best ${maze.best[i].split("").join(" or ")}`,
    ];
    at("state").textContent = `${parts.join("; ")}.`;
  };

  const curves = ({ maze, seed, step, run }) => {
    const here = runs.filter((one) => mazes[one.maze] === maze);
    const traces = here.map((one) => ({
      type: "scatter",
      mode: "lines",
      name: name(one.sampler),
      x: one.evaluated,
      y: one.returns[seed],
      line: { color: charts.colour(one.sampler), width: one === run ? 3 : 1.5 },
      opacity: one === run ? 1 : 0.7,
    }));
    const soft = theme.dark() ? "#9aa4af" : "#59636e";
    const layout = charts.layout({
      margin: { l: 10, r: 12, t: 8, b: 40 },
      xaxis: { title: { text: "step" }, fixedrange: true, zeroline: false },
      yaxis: { title: { text: "return" }, fixedrange: true },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
      shapes: [{ type: "line", x0: steps[step], x1: steps[step], yref: "paper", y0: 0, y1: 1,
        line: { color: soft, width: 1.5, dash: "dot" } }],
    });
    Plotly.react(at("curves"), traces, layout, charts.options);
  };

  const draw = () => {
    const { maze, run, seed, step, quantity, beside } = now();
    at("step-shown").textContent = `step ${steps[step].toLocaleString("en")}`;
    paint("left", maze, shares(run, seed, step, quantity, maze), run, seed, step);
    at("left-title").textContent = title(run, seed, step, maze, quantity);
    if (beside) {
      paint("right", maze, shares(beside, seed, step, quantity, maze), beside, seed, step);
      at("right-title").textContent = title(beside, seed, step, maze, quantity);
    } else {
      const points = maze.decision.map((is, i) => (maze.terminal[i] ? null : is));
      paint("right", maze, { shares: points, ends: ["0", "1"], stops: VIRIDIS }, null);
      const count = maze.decision.filter((is) => is).length;
      at("right-title").textContent = `The oracle's points: p is 1 at the ${count} decision points, and 0 elsewhere.`;
    }
    tell(now());
    curves(now());
  };

  // The samplers, seeds and neighbours that the chosen maze has.
  const offer = () => {
    const here = runs.filter((run) => run.maze === Number(at("maze").value));
    const samplers = here.map((run) => [run.sampler, name(run.sampler)]);
    charts.fill(at("sampler"), samplers, at("sampler").value);
    const { seeds } = here.find((run) => run.sampler === at("sampler").value);
    charts.fill(at("seed"), seeds.map((seed, i) => [i, seed]), at("seed").value);
    charts.fill(at("beside"), [[ORACLE, ORACLE], ...samplers], at("beside").value);
  };
  const stop = () => {
    clearInterval(playing);
    playing = null;
    at("play").textContent = "Play";
  };
  at("play").addEventListener("click", () => {
    if (playing) {
      stop();
      return;
    }
    const slider = at("step");
    if (slider.value === slider.max) slider.value = 0;
    draw();
    at("play").textContent = "Stop";
    playing = setInterval(() => {
      slider.stepUp();
      draw();
      if (slider.value === slider.max) stop();
    }, 900);
  });
  at("maze").addEventListener("input", () => {
    chosen = null;
    offer();
    draw();
  });
  for (const id of ["sampler", "seed", "quantity", "beside", "arrows"]) {
    at(id).addEventListener("input", draw);
  }
  at("step").addEventListener("input", () => {
    stop();
    draw();
  });
  for (const side of ["left", "right"]) {
    const choose = (event) => {
      const state = event.target.dataset.state;
      if (state === undefined || Number(state) === chosen) return;
      chosen = Number(state);
      tell(now());
    };
    at(side).addEventListener("pointerover", choose);
    at(side).addEventListener("click", choose);
  }
  offer();
  document.addEventListener("theme", draw);
})();
