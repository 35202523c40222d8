// The slider of C(M; M'): draws, in place of a still picture, the numbers of worlds-data.js (made by docs/worlds.py).
(() => {
  const place = document.querySelector(".worlds");
  if (!place || typeof WORLDS === "undefined") return;
  const narrow = place.clientWidth < 480;
  const WIDTH = narrow ? 360 : 640, HEIGHT = narrow ? 300 : 360, LEFT = 46, RIGHT = 12, TOP = 12, BOTTOM = 44, CHEAPEST = 26, DEAREST = 66;
  const ACTS = { low: WORLDS.low, high: WORLDS.high };
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let reaction = WORLDS.reactions[1], deployed = 0.2, moving = 0, rounds = 0;

  const x = (M) => LEFT + ((M - ACTS.low) / (ACTS.high - ACTS.low)) * (WIDTH - LEFT - RIGHT);
  const y = (cost) => TOP + ((DEAREST - cost) / (DEAREST - CHEAPEST)) * (HEIGHT - TOP - BOTTOM);
  const clamp = (M) => Math.min(Math.max(M, ACTS.low), ACTS.high);

  // Coefficients between two worlds of the grid, by the line between them.
  function world(M) {
    const place = (clamp(M) - ACTS.low) / WORLDS.step, last = reaction.a.length - 1;
    const i = Math.min(Math.floor(place), last - 1), part = place - i;
    const at = (values) => values[i] + part * (values[i + 1] - values[i]);
    return { a: at(reaction.a), b: at(reaction.b), c: at(reaction.c) };
  }
  const cost = (M, other) => { const { a, b, c } = world(other); return a + b * M + c * M * M; };
  const response = (other) => { const { b, c } = world(other); return -b / (2 * c); };
  const money = (value) => (value < 1000 ? value.toFixed(1) : value.toPrecision(2));

  const element = (name, attributes = {}, parent = null, text = "") => {
    const svg = ["svg", "path", "circle", "line", "text", "g", "clipPath", "rect"].includes(name);
    const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    if (parent) parent.append(made);
    return made;
  };

  place.replaceChildren();
  const choices = element("fieldset", {}, place);
  element("legend", {}, choices, "How the world reacts");
  WORLDS.reactions.forEach((each, index) => {
    const label = element("label", {}, choices);
    const radio = element("input", { type: "radio", name: "reaction", value: index }, label);
    radio.checked = each === reaction;
    label.append(` ${each.name}`);
    radio.addEventListener("change", () => { reaction = each; rounds = 0; deploy(0.2); });
  });

  const picture = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-labelledby": "worlds-says" }, place);
  const clip = element("clipPath", { id: "worlds-frame" }, picture);
  element("rect", { x: LEFT, y: TOP, width: WIDTH - LEFT - RIGHT, height: HEIGHT - TOP - BOTTOM }, clip);
  for (let value = 30; value < DEAREST; value += 10) {
    element("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value) }, picture);
    element("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, picture, `${value}`);
  }
  for (let M = 0; M < ACTS.high; M += narrow ? 0.5 : 0.25) {
    element("line", { class: "grid", x1: x(M), x2: x(M), y1: TOP, y2: HEIGHT - BOTTOM }, picture);
    element("text", { x: x(M), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }, picture, `${M}`);
  }
  element("text", { x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 8, "text-anchor": "middle" }, picture, "policy: how hard to push back");
  element("text", { x: 14, y: (TOP + HEIGHT - BOTTOM) / 2, "text-anchor": "middle", transform: `rotate(-90 14 ${(TOP + HEIGHT - BOTTOM) / 2})` }, picture, "expected cost");
  const drawing = element("g", { "clip-path": "url(#worlds-frame)" }, picture);
  const own = element("path", { class: "own" }, drawing);
  const frozen = element("path", { class: "frozen" }, drawing);
  const stand = element("line", { class: "stand" }, drawing);
  const gain = element("line", { class: "gain" }, drawing);
  const optimal = element("text", { class: "optimal", "text-anchor": "middle" }, drawing, "★");
  const stable = element("circle", { class: "stable", r: 8 }, drawing);
  const best = element("path", { class: "best" }, drawing);
  const here = element("circle", { class: "here", r: 5 }, drawing);

  const row = element("div", { class: "worlds-row" }, place);
  const label = element("label", { for: "worlds-deployed" }, row, "Deployed policy M′");
  const slider = element("input", { id: "worlds-deployed", type: "range", min: ACTS.low, max: ACTS.high, step: WORLDS.step }, label);
  const retrain = element("button", { type: "button", class: "md-button" }, row, "Retrain");
  const again = element("button", { type: "button", class: "md-button" }, row, "Start again");
  const says = element("p", { id: "worlds-says", "aria-live": "polite" }, place);
  const key = element("p", { class: "worlds-key" }, place);
  for (const [mark, text] of [["own", "cost in the world that the policy makes"], ["frozen", "cost in the world of M′, while it lasts"],
    ["stable", "stable policy"], ["optimal", "optimal policy"]]) {
    const item = element("span", {}, key);
    element("i", { class: `mark-${mark}` }, item, mark === "optimal" ? "★" : "");
    item.append(` ${text}`);
  }

  slider.addEventListener("input", () => { rounds = 0; deploy(+slider.value); });
  again.addEventListener("click", () => { rounds = 0; deploy(0.2); });
  retrain.addEventListener("click", () => {
    rounds += 1;
    const from = deployed, to = clamp(response(deployed)), began = performance.now(), mine = ++moving;
    if (still) return deploy(to);
    const step = (now) => {
      if (mine !== moving) return;
      const part = Math.min((now - began) / 700, 1);
      draw(from + (to - from) * (1 - (1 - part) ** 3));
      if (part < 1) requestAnimationFrame(step); else deploy(to);
    };
    requestAnimationFrame(step);
  });

  function curve(of) {
    let path = "";
    for (let M = ACTS.low; M <= ACTS.high + 1e-9; M += WORLDS.step) path += `${path ? "L" : "M"}${x(M).toFixed(1)} ${Math.max(y(of(M)), -900).toFixed(1)}`;
    return path;
  }

  function draw(M) {
    const now = cost(M, M), to = response(M), then = cost(to, M);
    own.setAttribute("d", curve((each) => cost(each, each)));
    frozen.setAttribute("d", curve((each) => cost(each, M)));
    here.setAttribute("cx", x(M)); here.setAttribute("cy", y(now));
    for (const [name, value] of Object.entries({ x1: x(M), x2: x(M), y1: TOP, y2: HEIGHT - BOTTOM })) stand.setAttribute(name, value);
    for (const [name, value] of Object.entries({ x1: x(M), x2: x(to), y1: y(now), y2: y(then) })) gain.setAttribute(name, value);
    best.setAttribute("d", `M${x(to) - 6} ${y(then) - 5}h12l-6 10z`);
    const policies = reaction.policies;
    stable.setAttribute("cx", x(policies.stable[0])); stable.setAttribute("cy", y(policies.stable[1]));
    optimal.setAttribute("x", x(policies.optimal[0])); optimal.setAttribute("y", y(policies.optimal[1]) + 7);
  }

  function deploy(M) {
    moving += 1;
    deployed = M;
    slider.value = M;
    slider.setAttribute("aria-valuetext", M.toFixed(2));
    draw(M);
    const to = response(M), after = clamp(to);
    const { stable: [, stableCost], optimal: [, optimalCost] } = reaction.policies;
    const count = rounds ? `After ${rounds} round${rounds > 1 ? "s" : ""} of retraining: ` : "";
    says.textContent = Math.abs(to - M) < 0.002
      ? `${count}M′ = ${M.toFixed(2)} costs ${money(cost(M, M))}, and no other policy is cheaper in its world. It is stable. The optimal policy costs ${money(optimalCost)} in its own.`
      : after !== to
        ? `${count}M′ = ${M.toFixed(2)} costs ${money(cost(M, M))}. Retraining would go beyond the picture, to ${to.toFixed(2)}: it runs away from the stable policy, which costs ${money(stableCost)}.`
        : `${count}M′ = ${M.toFixed(2)} costs ${money(cost(M, M))}. While the world stays as it is, ${to.toFixed(2)} would cost ${money(cost(to, M))}; once it has reacted, ${money(cost(to, to))}.`;
  }
  deploy(deployed);
})();
