(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)").matches;

  // ---- figures: colours are names (@c0, or @c0/0.2 with an opacity) until the theme is known
  const palette = () => (dark.matches ? data.palette.dark : data.palette.light);

  function colour(text, colours) {
    const found = /^@(\w+)(?:\/([\d.]+))?$/.exec(text);
    if (!found) return text;
    const hex = colours[found[1]];
    if (found[2] === undefined) return hex;
    const [red, green, blue] = [1, 3, 5].map((place) => parseInt(hex.slice(place, place + 2), 16));
    return `rgba(${red},${green},${blue},${found[2]})`;
  }

  function themed(value, colours, inColour = false) {
    if (typeof value === "string") return inColour ? colour(value, colours) : value;
    if (Array.isArray(value)) return value.map((item) => themed(item, colours, inColour));
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, themed(item, colours, inColour || /color$|^colorscale$/.test(key))]));
  }

  const config = { responsive: true, displayModeBar: false };

  function draw(holder) {
    const figure = data.figures[holder.dataset.figure];
    const plots = [...holder.querySelectorAll(".plot")];
    const hidden = holder.hiddenNames;
    const work = plots.map((plot, number) => {
      const panel = themed(figure.panels[number], palette());
      panel.data.forEach((trace) => { trace.visible = !hidden.has(trace.name); });
      // A finger on a figure scrolls the page; it does not drag the axes away.
      panel.layout.dragmode = touch ? false : "zoom";
      if (touch) { panel.layout.xaxis.fixedrange = true; panel.layout.yaxis.fixedrange = true; }
      panel.layout.showlegend = false;
      if (panel.narrow.length && plot.clientWidth < 480) panel.layout.yaxis.ticktext = panel.narrow;
      return Plotly.react(plot, panel.data, panel.layout, config);
    });
    return Promise.all(work);
  }

  const GLYPHS = { circle: "●", diamond: "◆", star: "★", x: "✕" };

  function swatch(trace) {
    const markers = trace.mode === "markers" || trace.mode === "markers+text";
    const made = document.createElement(markers ? "b" : "i");
    const name = trace.type === "bar" || markers ? trace.marker.color : trace.line.color;
    if (markers) {
      made.textContent = GLYPHS[trace.marker.symbol];
      made.style.color = `var(--${name.slice(1)})`;
    } else {
      made.className = trace.type === "bar" ? "bar" : trace.line.dash === "dash" ? "dash" : "";
      made.style.backgroundColor = `var(--${name.slice(1)})`;
    }
    return made;
  }

  function legends(holder) {
    const figure = data.figures[holder.dataset.figure];
    const panels = figure.panels.map((panel) => {
      const named = new Map();
      panel.data.forEach((trace) => { if (trace.showlegend !== false && !named.has(trace.name)) named.set(trace.name, trace); });
      return named;
    });
    const traces = panels.flatMap((named) => [...named.values()]);
    holder.hiddenNames = new Set(traces.filter((trace) => trace.visible === "legendonly").map((trace) => trace.name));
    // Panels that show parts of the same share one legend; others have each their own.
    const most = panels.reduce((best, named) => (named.size > best.size ? named : best), new Map());
    const shared = panels.every((named) => [...named].every(([name, trace]) => most.has(name) && swatch(trace).outerHTML === swatch(most.get(name)).outerHTML));
    if (shared) return legend(holder, most, holder.querySelector(":scope > .legend"));
    panels.forEach((named, number) => legend(holder, named, holder.querySelectorAll(".panel > .legend")[number]));
  }

  function legend(holder, named, place) {
    if (named.size < 2) return;
    for (const [name, trace] of named) {
      const button = document.createElement("button");
      const text = document.createElement("span");
      text.innerHTML = name;  // escaped when the page was written: plotly reads entities in names too
      button.type = "button";
      button.append(swatch(trace), text);
      const show = () => button.setAttribute("aria-pressed", String(!holder.hiddenNames.has(name)));
      button.addEventListener("click", () => {
        if (!holder.hiddenNames.delete(name)) holder.hiddenNames.add(name);
        show();
        draw(holder);
      });
      show();
      place.append(button);
    }
  }

  async function drawAll(holders) {
    for (const holder of holders) {
      await draw(holder);
      holder.dataset.drawn = "true";
      await new Promise((done) => setTimeout(done, 0));
    }
    document.documentElement.dataset.ready = "true";
  }

  // ---- episodes
  const PHASES = [["upload", "c3"], ["inference", "c4"], ["download", "c5"], ["motion", "c0"]];
  const PAGE = 40;

  function element(tag, className, text) {
    const made = document.createElement(tag);
    if (className) made.className = className;
    if (text !== undefined) made.textContent = text;
    return made;
  }

  const plain = (name) => name.replaceAll("_", " ");
  const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "\u2212"));

  function outcome(episode) {
    if (episode.error) return ["error", "error"];
    return episode.success >= 0.5 ? ["success", "success"] : ["failure", "not done"];
  }

  function chip(episode) {
    const [kind, word] = outcome(episode);
    return element("span", `chip ${kind}`, word);
  }

  function options(select, all, values, names = values) {
    select.append(new Option(all, ""));
    values.forEach((value, number) => select.append(new Option(names[number], value)));
    select.closest("label").hidden = values.length < 2;
  }

  function episodes(book) {
    const columns = Object.keys(book.episodes);
    const all = book.episodes.instance.map((_, row) => Object.fromEntries(columns.map((name) => [name, book.episodes[name][row]])));
    all.forEach((episode) => { episode.about = book.instances[episode.instance]; episode.policyName = book.policies[episode.policy]; });
    const controls = Object.fromEntries(["task", "robot", "target", "policy", "outcome", "kind", "text"].map((name) => [name, document.getElementById(`filter-${name}`)]));
    const distinct = (values) => [...new Set(values.filter(Boolean))].sort();
    options(controls.task, "all tasks", distinct(book.instances.map((item) => item.task)));
    options(controls.robot, "all robots", distinct(book.instances.map((item) => item.robot)));
    const targets = distinct(book.instances.map((item) => item.target));
    options(controls.target, "anything", targets, targets.map(plain));
    options(controls.policy, "all policies", book.policies);
    const outcomes = [["success", "success"], ["failure", "not done"], ["fallback", "fell back to the local policy"], ["error", "error"]].filter(([kind]) => all.some((episode) => ended(episode, kind)));
    options(controls.outcome, "any outcome", outcomes.map((kind) => kind[0]), outcomes.map((kind) => kind[1]));
    const kinds = [["chosen", "what was chosen"], ["differ", "where policies differ"], ["pictures", "with pictures"]].filter(([kind]) => all.some((episode) => shown(episode, kind)));
    options(controls.kind, "all episodes", kinds.map((kind) => kind[0]), kinds.map((kind) => kind[1]));
    controls.kind.closest("label").hidden = kinds.length === 0;
    if (kinds.some(([kind]) => kind === "chosen")) controls.kind.value = "chosen";

    function shown(episode, kind) {
      if (kind === "chosen") return episode.chosen === 1;
      if (kind === "differ") return episode.about.differ === true;
      if (kind === "pictures") return Boolean(episode.video) || Boolean(episode.about.scene);
      return true;
    }

    function ended(episode, kind) {
      return kind === "fallback" ? Boolean(episode.fallback) : outcome(episode)[0] === kind;
    }

    function fits(episode) {
      const wanted = controls.outcome.value;
      return (!controls.task.value || episode.about.task === controls.task.value)
        && (!controls.robot.value || episode.about.robot === controls.robot.value)
        && (!controls.target.value || episode.about.target === controls.target.value)
        && (!controls.policy.value || episode.policyName === controls.policy.value)
        && (!wanted || ended(episode, wanted))
        && shown(episode, controls.kind.value)
        && (episode.about.instruction || "").toLowerCase().includes(controls.text.value.trim().toLowerCase());
    }

    // Outcomes with a grade, where the log has them.
    const GRADED = [
      ["subgoals", (value) => (value === null ? "–" : `${Math.round(100 * value)}%`)],
      ["score", (value) => fixed(value, book.digits.score)],
    ].filter(([name]) => name in book.episodes);
    const list = document.getElementById("episode-list");
    const more = document.getElementById("episode-more");
    let found = [];

    function row(episode) {
      const button = element("button", "episode");
      button.type = "button";
      button.append(
        element("span", "number-of wide-only", String(episode.about.number)),
        element("span", "instruction", episode.about.instruction || episode.about.key),
        element("span", "", episode.policyName));
      const result = element("span");
      result.append(chip(episode));
      button.append(result,
        element("span", "right wide-only", fixed(episode.reward, 2)),
        element("span", "right wide-only", fixed(episode.seconds, book.digits.seconds)),
        element("span", "right wide-only", fixed(episode.price, book.digits.price)));
      button.addEventListener("click", () => open(episode));
      return button;
    }

    function extend(count) {
      const start = list.querySelectorAll("button").length;
      list.append(...found.slice(start, start + count).map(row));
      more.hidden = start + count >= found.length;
    }

    function filter() {
      found = all.filter(fits);
      const head = element("div", "episode head");
      ["#", "instruction", "policy", "outcome", "reward", "seconds", "cents"].forEach((name, place) => head.append(element("span", place > 3 ? "right" : "", name)));
      const none = element("p", "", "No episode fits.");
      none.id = "episode-none";
      list.replaceChildren(...(found.length ? [head] : [none]));
      document.getElementById("episode-count").textContent = `${found.length.toLocaleString("en")} of ${all.length.toLocaleString("en")} episodes`;
      extend(PAGE);
    }

    function comparison(episode) {
      const table = element("table");
      const head = table.createTHead().insertRow();
      ["policy", "outcome", ...GRADED.map(([name]) => name), "reward", "steps", "seconds", "where the time went", "cents"].forEach((name) => head.append(element("th", "", name)));
      const body = table.createTBody();
      for (const other of all.filter((item) => item.instance === episode.instance)) {
        const line = body.insertRow();
        const name = other.policyName + (other.chosen === 1 ? " (chosen)" : "") + (other.repeat > 0 ? `, repeat ${other.repeat}` : "");
        line.insertCell().append(element("div", "name", name));
        line.insertCell().append(chip(other));
        GRADED.forEach(([name, shown]) => { line.insertCell().textContent = shown(other[name]); });
        [[other.reward, 3], [other.steps, 0], [other.seconds, book.digits.seconds]].forEach(([value, digits]) => { line.insertCell().textContent = fixed(value, digits); });
        line.insertCell().append(phases(other));
        line.insertCell().textContent = fixed(other.price, book.digits.price);
        if (other === episode) line.style.fontWeight = "650";
      }
      const holder = element("div", "wide");
      holder.append(table);
      return holder;
    }

    function phases(episode) {
      // While an answer is on its way the robot waits: motion contains the other three, so its bar shows what is left of it.
      const waiting = PHASES.slice(0, 3).map(([name]) => episode[name] || 0);
      const parts = [...waiting, Math.max(0, (episode.motion || 0) - waiting.reduce((sum, value) => sum + value, 0))];
      const total = parts.reduce((sum, value) => sum + value, 0);
      const bar = element("div", "phases");
      bar.title = PHASES.map(([name], place) => `${name === "motion" ? "rest of motion" : name} ${parts[place].toFixed(2)} s`).join(", ");
      parts.forEach((value, place) => {
        const part = element("i");
        part.style.width = `${total ? (100 * value) / total : 0}%`;
        part.style.backgroundColor = `var(--${PHASES[place][1]})`;
        bar.append(part);
      });
      return bar;
    }

    function summary(episode) {
      const line = element("p", "summary");
      line.append(element("strong", "", episode.policyName), " ", chip(episode));
      const parts = [["reward", episode.reward, 3, ""], ["", episode.steps, 0, " steps"], ["", episode.seconds, book.digits.seconds, " s"], ["", episode.price, book.digits.price, " cents"]];
      const graded = GRADED.filter(([name]) => episode[name] !== null).map(([name, shown]) => `${name} ${shown(episode[name])}`);
      line.append(" ", [...graded, ...parts.filter(([, value]) => value !== null).map(([name, value, digits, unit]) => `${name} ${fixed(value, digits)}${unit}`.trim())].join(" · "));
      return line;
    }

    // Over all seeds of a replay: which policy each selector chose for this instance.
    function picks(episode) {
      const names = Object.keys(book.picks);
      const known = names.filter((name) => book.picks[name][episode.instance].some((share) => share !== null));
      if (!known.length) return [];
      const table = element("table");
      const head = table.createTHead().insertRow();
      const first = element("th");
      first.append(element("div", "name", "chosen by, over all seeds"));
      head.append(first, ...book.policies.map((name) => element("th", "", name)));
      const body = table.createTBody();
      for (const name of known) {
        const line = body.insertRow();
        line.insertCell().append(element("div", "name", name));
        book.picks[name][episode.instance].forEach((share) => { line.insertCell().textContent = `${Math.round(100 * share)}%`; });
      }
      const holder = element("div", "wide spaced");
      holder.append(table);
      return [holder];
    }

    function open(episode) {
      const body = document.getElementById("detail-body");
      const about = episode.about;
      const title = element("h3", "", about.instruction || about.key);
      title.id = "detail-title";
      const facts = [about.key, about.target && `asked for: ${plain(about.target)}${about.container ? ` to ${plain(about.container)}` : ""}`, about.phrasing && `wording: ${plain(about.phrasing)}`];
      body.replaceChildren(title, element("p", "caption", facts.filter(Boolean).join(" · ")), summary(episode));
      const video = episode.video && book.videos[episode.video];
      if (video) {
        const player = element("video");
        player.controls = true;
        player.muted = true;
        player.playsInline = true;
        player.src = video.data ? blob(video) : video.file;
        body.append(player);
      }
      const pictures = [...(about.scene ? [about.scene] : []), ...(video ? video.frames : [])];
      if (pictures.length) {
        const strip = element("div", "frames");
        pictures.forEach((picture, number) => {
          const image = element("img");
          image.src = `data:image/jpeg;base64,${picture}`;
          image.alt = number === 0 && about.scene ? "the scene at the start" : "a moment of the episode";
          strip.append(image);
        });
        body.append(strip);
      } else if (about.drawable && !video) {
        body.append(element("p", "caption", "No picture of it here: python -m osel_sim.report with --scenes N draws how N instances begin, again from their seeds."));
      }
      if (episode.error) body.append(element("p", "", `Ended in error: ${episode.error}`));
      if (episode.fallback) body.append(element("p", "", `Fell back to the local policy: ${episode.fallback}`));
      const key = element("p", "caption key");
      PHASES.forEach(([name, colourName]) => {
        const part = element("span");
        const dot = element("i");
        dot.style.backgroundColor = `var(--${colourName})`;
        part.append(dot, name === "motion" ? "rest of motion" : name);
        key.append(part);
      });
      body.append(comparison(episode), key, ...picks(episode));
      document.getElementById("detail").showModal();
    }

    // Safari plays a video from a blob, not from a data address.
    function blob(video) {
      if (!video.url) {
        const bytes = Uint8Array.from(atob(video.data), (character) => character.charCodeAt(0));
        video.url = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
      }
      return video.url;
    }

    Object.values(controls).forEach((control) => control.addEventListener("input", filter));
    more.addEventListener("click", () => extend(PAGE));
    filter();
  }

  const detail = document.getElementById("detail");
  detail.addEventListener("click", (event) => { if (event.target === detail) detail.close(); });
  detail.addEventListener("close", () => detail.querySelectorAll("video").forEach((video) => video.pause()));

  if (data.episodes) episodes(data.episodes);
  const holders = [...document.querySelectorAll("figure[data-figure]")];
  holders.forEach(legends);
  drawAll(holders);
  dark.addEventListener("change", () => holders.forEach(draw));
})();
