// Reads [{latex, display}, ...] as JSON, writes [{html} or {error}, ...]: called by hooks.py once a page.
const katex = require("./assets/katex/katex.min.js");

const equations = JSON.parse(require("fs").readFileSync(0, "utf8"));
const drawn = equations.map(({ latex, display }) => {
  try {
    return { html: katex.renderToString(latex, { displayMode: display, strict: "error", throwOnError: true }) };
  } catch (error) {
    return { error: error.message };
  }
});
process.stdout.write(JSON.stringify(drawn));
