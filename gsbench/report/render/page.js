"use strict";
// Figures, a legend that hides models, the choice of a scene, sorting and filtering of tables, the slider between images,
// and reloading of a live page.
const each = (selector, act, root = document) => root.querySelectorAll(selector).forEach(act);
const parsed = (id) => JSON.parse(document.getElementById(id).textContent);
const specs = parsed("specs");
const views = new Map(); // by element of a figure: its Vega view

const hidden = (article) => [...article.querySelectorAll("button.model[aria-pressed=false]")].map((b) => b.dataset.series);
const update = (chart) => { // bring a figure to what the legend and the choice of a scene say
  const view = views.get(chart);
  if (!view) return;
  const choice = chart.closest("section").querySelector("select.scene");
  const set = (name, value) => { try { view.signal(name, value); } catch { /* this figure has no such choice */ } };
  set("hidden", hidden(chart.closest("article")));
  if (choice) set("scene", choice.value);
  view.runAsync();
};
const draw = async (chart) => {
  if (views.has(chart)) return;
  views.set(chart, null);
  const options = { actions: false, renderer: "svg", ast: true, logLevel: 1, tooltip: { theme: "custom" } };
  const { view } = await window.vegaEmbed(chart, specs[chart.dataset.spec], options);
  views.set(chart, view);
  update(chart);
};
const near = new IntersectionObserver((entries) => { // figures are drawn when they come near the screen
  entries.filter((entry) => entry.isIntersecting).forEach((entry) => { near.unobserve(entry.target); draw(entry.target); });
}, { rootMargin: "600px" });
each(".chart", (chart) => near.observe(chart));
addEventListener("beforeprint", () => each(".chart", draw));

each("button.model", (button) => button.addEventListener("click", () => {
  const article = button.closest("article");
  const shown = button.getAttribute("aria-pressed") !== "true";
  each("button.model", (other) => {
    if (other.dataset.series === button.dataset.series) other.setAttribute("aria-pressed", shown);
  }, article);
  each(".chart", update, article);
}));
each("select.scene", (select) => {
  const kept = `scene ${location.pathname}${select.closest("section").id}`;
  try {
    const before = sessionStorage.getItem(kept);
    if ([...select.options].some((option) => option.value === before)) select.value = before;
  } catch { /* storage may be forbidden for files */ }
  select.addEventListener("change", () => {
    try { sessionStorage.setItem(kept, select.value); } catch { /* as above */ }
    each(".chart", update, select.closest("section"));
  });
});

const MOST_CHOICES = 60; // of a filter
const shown = (cell) => cell.textContent.trim();
each(".sortable", (box) => { // a click on a title sorts the rows, and a choice of a column hides all others
  const [head, ...rows] = box.querySelectorAll("tr");
  const titles = [...head.cells];
  const value = (row, i) => {
    const text = shown(row.cells[i]);
    if (!titles[i].classList.contains("number")) return text;
    return text === "never" ? Infinity : parseFloat(text.replaceAll(",", "")); // a missing number is NaN
  };
  const controls = document.createElement("div");
  controls.className = "controls";
  const count = document.createElement("span");
  count.setAttribute("role", "status");
  const filters = new Map(); // by column: its choice
  const show = () => {
    let above = null;
    for (const row of box.querySelectorAll("tr:not(:first-child)")) {
      row.hidden = [...filters].some(([i, select]) => select.value && shown(row.cells[i]) !== select.value);
      if (row.hidden) continue;
      row.cells[0].classList.toggle("repeated", shown(row.cells[0]) === above);
      above = shown(row.cells[0]);
    }
    count.textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length} rows`;
  };
  const sort = (i) => {
    const was = titles[i].getAttribute("aria-sort");
    const isNumber = titles[i].classList.contains("number");
    const down = was ? was === "ascending" : isNumber;
    titles.forEach((title) => title.removeAttribute("aria-sort"));
    titles[i].setAttribute("aria-sort", down ? "descending" : "ascending");
    const order = (a, b) => {
      const [x, y] = [value(a, i), value(b, i)];
      if (!isNumber) return x.localeCompare(y) * (down ? -1 : 1);
      return Number.isNaN(x) - Number.isNaN(y) || (x - y) * (down ? -1 : 1) || 0;
    };
    head.after(...[...box.querySelectorAll("tr:not(:first-child)")].sort(order));
    show();
  };
  titles.forEach((title, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.append(...title.childNodes);
    button.addEventListener("click", () => sort(i));
    title.append(button);
    const choices = [...new Set(rows.map((row) => shown(row.cells[i])))].filter(Boolean).sort();
    const isChoice = choices.length > 1 && choices.length < rows.length && choices.length <= MOST_CHOICES;
    if (title.classList.contains("number") || !isChoice) return;
    const [label, select] = [document.createElement("label"), document.createElement("select")];
    select.append(new Option("all", ""), ...choices.map((choice) => new Option(choice, choice)));
    select.addEventListener("change", show);
    label.append(shown(title), select);
    controls.append(label);
    filters.set(i, select);
  });
  controls.append(count);
  box.before(controls);
  show();
});

const pictures = parsed("views");
each(".compare", (root) => {
  const shots = pictures[root.dataset.views];
  const part = (name) => root.querySelector(`.${name}`);
  const fill = (select, options, chosen) => {
    select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    if (options.some(([value]) => value === chosen)) select.value = chosen;
  };
  const source = (shot, choice) => {
    const [kind, model] = choice.split(":");
    return kind === "truth" ? shot.truth : shot[kind][model];
  };
  const show = () => {
    const shot = shots[part("view").value];
    root.querySelector(".stage").style.aspectRatio = `${shot.width} / ${shot.height}`;
    for (const [side, image] of [["left", "over"], ["right", "under"]]) {
      const text = part(side).selectedOptions[0].textContent;
      const score = shot.scores[part(side).value.split(":")[1]];
      part(image).src = source(shot, part(side).value);
      part(image).alt = `${text} of ${shot.scene}, ${shot.name}`;
      part(`${side}-name`).textContent = score ? `${text}: ${score}` : text;
    }
  };
  const change = () => {
    const models = Object.keys(shots[part("view").value].render);
    const options = [["truth:", "ground truth"], ...models.map((m) => [`render:${m}`, m]), ...models.map((m) => [`error:${m}`, `${m}, error`])];
    const [left, right] = [part("left").value, part("right").value];
    const best = models.includes(root.dataset.best) ? root.dataset.best : models[models.length - 1];
    fill(part("left"), options, left || `render:${best}`);
    fill(part("right"), options, right || "truth:");
    show();
  };
  fill(part("view"), shots.map((shot, i) => [String(i), `${shot.scene}, ${shot.name}`]), "0");
  part("view").addEventListener("change", change);
  part("left").addEventListener("change", show);
  part("right").addEventListener("change", show);
  const slider = root.querySelector("input");
  const move = () => root.style.setProperty("--share", `${slider.value}%`);
  slider.addEventListener("input", move);
  move();
  change();
});

const wait = Number(document.body.dataset.reload);
if (wait) {
  setInterval(() => {
    const busy = !getSelection().isCollapsed || document.activeElement.matches("select, input");
    if (!busy && !document.hidden) location.reload();
  }, wait * 1000);
}
