(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("data").textContent);

  // ---- figures. Each is a Vega-Lite specification of panels in the colours of the light theme; here they become those of the page, by name.
  const NARROW = 480;
  const names = new Map(Object.entries(data.palette.light).map(([name, value]) => [value, `var(--${name})`]));
  const holders = [...document.querySelectorAll("figure[data-figure]")];

  const COLOURS = /^(range|color|fill|stroke|background)$|Color$/;
  const WORDS = new Set(["domain", "values", "datasets"]);  // a name may look like a colour

  function themed(value, inColour = false) {
    if (typeof value === "string") return inColour && names.has(value) ? names.get(value) : value;
    if (Array.isArray(value)) return value.map((item) => themed(item, inColour));
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, themed(item, !WORDS.has(key) && (inColour || COLOURS.test(key)))]));
  }

  const layersOf = (panel) => [panel, ...(panel.layer || [])];

  // The specification's legend is for images: here a row of buttons hides and shows.
  function legendOf(panel) {
    for (const { encoding, mark } of layersOf(panel)) {
      const scale = encoding?.color?.legend && encoding.color.scale;
      if (!scale?.domain) continue;
      const of = (channel) => layersOf(panel).map((layer) => layer.encoding?.[channel]?.scale?.range).find(Boolean);
      const dashes = of("strokeDash"), shapes = of("shape");
      const kind = dashes ? "line" : shapes ? "point" : mark.type || mark;
      return scale.domain.map((name, place) => ({ name, kind, colour: names.get(scale.range[place]), dashed: dashes?.[place][1] > 0, shape: shapes?.[place] }));
    }
    return [];
  }

  const GLYPHS = { circle: "●", diamond: "◆", cross: "✚", "triangle-up": "▲" };

  function swatch({ kind, colour, dashed, shape }) {
    const made = document.createElement(shape && kind !== "line" ? "b" : "i");
    if (shape && kind !== "line") made.textContent = GLYPHS[shape];
    else made.className = kind === "line" ? (dashed ? "dash" : "") : "bar";
    made.style.setProperty("--own", colour);
    return made;
  }

  function legend(holder, entries, place) {
    for (const entry of entries) {
      const button = document.createElement("button");
      const text = document.createElement("span");
      text.textContent = entry.name;
      button.type = "button";
      button.append(swatch(entry), text);
      const show = () => button.setAttribute("aria-pressed", String(!holder.hiddenNames.has(entry.name)));
      button.addEventListener("click", () => {
        if (!holder.hiddenNames.delete(entry.name)) holder.hiddenNames.add(entry.name);
        show();
        holder.views.forEach((view) => view.signal("hidden", [...holder.hiddenNames]).runAsync());
      });
      show();
      place.append(button);
    }
  }

  function legends(holder) {
    const spec = data.figures[holder.dataset.figure];
    holder.hiddenNames = new Set(spec.params.find((param) => param.name === "hidden").value);
    holder.views = [];
    const panels = spec.concat.map(legendOf);
    const shared = panels.every((entries) => JSON.stringify(entries) === JSON.stringify(panels[0]));
    if (shared) return legend(holder, panels[0], holder.querySelector(":scope > .legend"));
    panels.forEach((entries, number) => legend(holder, entries, holder.querySelectorAll(".panel > .legend")[number]));
  }

  // A closed fold has no width in some browsers: it will be that of its panel's share of the page.
  function widthOf(plot) {
    if (plot.clientWidth) return plot.clientWidth;
    const most = Number(plot.closest(".panels").style.getPropertyValue("--most"));
    const room = document.querySelector("main").clientWidth - 40;
    return Math.floor(room / Math.max(1, Math.min(most, Math.floor(room / 340)))) - 26;
  }

  // Names of columns stand slanted where they are wider than these; how far the last one then reaches beyond its column.
  function slant({ axis, scale }, width) {
    const column = (0.74 * width) / scale.domain.length;
    const letters = (name) => Math.min(axis.labelLimit, 6.2 * name.length);
    axis.labelAngle = Math.max(...scale.domain.map(letters)) < column ? 0 : -35;
    return axis.labelAngle ? Math.max(0, 0.82 * letters(scale.domain[scale.domain.length - 1]) - column / 2) : 0;
  }

  // A title in lines of at most so many letters.
  function broken(title, letters) {
    const lines = [""];
    for (const word of title.split(" ")) {
      if (lines[lines.length - 1].length + word.length < letters) lines[lines.length - 1] += ` ${word}`;
      else lines.push(word);
    }
    return lines.map((line) => line.trim()).filter(Boolean);
  }

  function fitted(spec, panel, width) {
    const { $schema, config, datasets, data: common } = spec;  // panels of the same data have it once, above them
    const fit = structuredClone({ ...(common && { data: common }), ...panel, $schema, config, datasets });
    fit.params = [{ name: "hidden", value: [] }];
    fit.width = width;
    delete fit.title;  // a heading above the panel, which breaks where it must
    fit.autosize = { type: "fit-x", contains: "padding" };
    for (const layer of layersOf(fit)) {
      for (const [channel, own] of Object.entries(layer.encoding || {})) {
        if (channel === "x" && own.type === "nominal") fit.padding = { left: 5, top: 5, bottom: 5, right: 5 + Math.round(slant(own, width)) };
        if (own.field === "name" && ["color", "shape", "strokeDash"].includes(channel)) own.legend = null;
        if (width >= NARROW) continue;
        if (channel === "x" && own.title) own.title = broken(own.title, (0.7 * width) / 6.5);
        if (own.legend) Object.assign(own.legend, { title: broken(own.legend.title, (0.7 * width) / 6), columns: 3 });
        if (!own.axis) continue;
        if (channel === "y" && own.type === "nominal") own.axis.labelLimit = Math.round(width / 3.4);
        if (channel === "x" && own.type === "quantitative") own.axis.tickCount = 4;
      }
    }
    return themed(fit);
  }

  async function draw(holder) {
    const spec = data.figures[holder.dataset.figure];
    const plots = [...holder.querySelectorAll(".plot")];
    const widths = plots.map(widthOf);
    if (holder.widths === widths.join()) return;
    holder.widths = widths.join();
    holder.views.forEach((view) => view.finalize());
    holder.views = [];
    for (const [number, plot] of plots.entries()) {
      const fit = fitted(spec, spec.concat[number], widths[number]);
      fit.params[0].value = [...holder.hiddenNames];
      // Without code made from text (`ast`): the page's policy allows none.
      const { view } = await vegaEmbed(plot, fit, { ast: true, renderer: "svg", actions: false, tooltip: { disableDefaultStyle: true } });
      view.addEventListener("click", (_, item) => { if (item?.datum?.instance !== undefined) show(item.datum); });
      holder.views.push(view);
    }
    holder.dataset.drawn = "true";
  }

  async function drawAll() {
    for (const holder of holders) await draw(holder);
    performance.mark("drawn");
    document.documentElement.dataset.ready = "true";
  }

  let show = () => {};  // opens the episodes of a context; there may be none

  // ---- tables: one that is wider than its column becomes a card for each row
  const fit = (wide) => {
    wide.classList.remove("stacked");
    wide.classList.toggle("stacked", wide.querySelector("table").scrollWidth > wide.clientWidth + 1);
  };
  function labelled(wide) {
    const headings = [...wide.querySelectorAll("th")].map((cell) => cell.textContent);
    wide.querySelectorAll("td").forEach((cell, place) => {
      cell.dataset.label = headings[place % headings.length];
      const interval = cell.querySelector(".interval");
      if (interval) cell.title = `95% interval ${interval.textContent}`;
    });
  }

  const tables = [...document.querySelectorAll(".table-block .wide")];
  tables.forEach(labelled);

  // ---- printing unfolds everything; afterwards it is as it was
  let folded = [];
  window.addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details.fold:not([open])")];
    folded.forEach((fold) => { fold.open = true; });
  });
  window.addEventListener("afterprint", () => folded.forEach((fold) => { fold.open = false; }));

  // ---- episodes
  // Shades of ink: colours are the policies'.
  const PHASES = [["upload", 0.95], ["inference", 0.65], ["download", 0.4], ["motion", 0.18]];
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
        part.style.opacity = PHASES[place][1];
        bar.append(part);
      });
      return bar;
    }

    function summary(episode) {
      const line = element("p", "summary");
      line.append(element("strong", "", episode.policyName), " ", chip(episode));
      const parts = [["reward", episode.reward, 3, ""], ["", episode.steps, 0, " steps"], ["", episode.seconds, book.digits.seconds, " s"], ["", episode.price, book.digits.price, " cents"]];
      const graded = GRADED.filter(([name]) => episode[name] !== null).map(([name, shown]) => `${name} ${shown(episode[name])}`);
      line.append(" ", [...graded, ...parts.filter(([, value]) => value !== null && value !== undefined).map(([name, value, digits, unit]) => `${name} ${fixed(value, digits)}${unit}`.trim())].join(" · "));
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
      PHASES.forEach(([name, shade]) => {
        const part = element("span");
        const dot = element("i");
        dot.style.opacity = shade;
        part.append(dot, name === "motion" ? "rest of motion" : name);
        key.append(part);
      });
      body.append(comparison(episode), key, ...picks(episode));
      document.getElementById("detail").showModal();
      body.querySelectorAll(".wide").forEach((wide) => { labelled(wide); fit(wide); });
    }

    // Safari plays a video from a blob, not from a data address.
    function blob(video) {
      if (!video.url) {
        const bytes = Uint8Array.from(atob(video.data), (character) => character.charCodeAt(0));
        video.url = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
      }
      return video.url;
    }

    // Of an instance what was chosen, or its first episode; of many instances the page has but some.
    show = ({ instance, about }) => {
      const own = all.filter((episode) => episode.about.number === instance);
      if (own.length) return open(own.find((episode) => episode.chosen === 1) || own[0]);
      const title = element("h3", "", about);
      title.id = "detail-title";
      document.getElementById("detail-body").replaceChildren(title, element("p", "caption", `Instance ${instance}: its episodes are not among those of this page.`));
      return document.getElementById("detail").showModal();
    };
    Object.values(controls).forEach((control) => control.addEventListener("input", filter));
    more.addEventListener("click", () => extend(PAGE));
    filter();
  }

  const detail = document.getElementById("detail");
  detail.addEventListener("click", (event) => { if (event.target === detail) detail.close(); });
  detail.addEventListener("close", () => detail.querySelectorAll("video").forEach((video) => video.pause()));

  if (data.episodes) episodes(data.episodes);
  holders.forEach(legends);
  const watch = new ResizeObserver((entries) => entries.forEach(({ target }) => {
    if (target.clientWidth === target.fittedWidth) return;
    target.fittedWidth = target.clientWidth;
    fit(target);
  }));
  tables.forEach((wide) => watch.observe(wide));
  let width = window.innerWidth;
  let waiting;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width) return;  // a phone's address bar comes and goes
    width = window.innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(drawAll, 200);
  });
  // The first screen first. What follows is one task, so that it is done before anything else happens to the page, such as printing.
  Promise.all(holders.slice(0, 1).map(draw)).then(() => setTimeout(drawAll, 0));
})();
