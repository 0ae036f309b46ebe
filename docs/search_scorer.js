// Ranks what the search of the site finds: a page about the words first, then the command or the function of that name.
const ALIASES = {
  install: "installation", setup: "installation", error: "errors", sb3: "environments", "collision rate": "metrics", "success rate": "metrics",
};
const asked = () => (new URLSearchParams(window.location.search).get("q") ?? "").toLowerCase().trim();

var Scorer = {
  score: ([name, title, anchor, , score, , kind]) => {
    const query = asked();
    const words = query.split(/\s+/);
    const last = name.split("/").pop();
    const isReference = name.startsWith("reference/");
    const isCode = /^h3-[a-z]+-\d{3}$/.test(query);
    if (last === query || last === ALIASES[query] || last === words.join("-") || (isCode && name === "errors")) {
      // the page itself, and not a section of it
      return (isReference ? 200 : 300) + (anchor === "" ? 10 : 0);
    }
    if (title.toLowerCase() === query) return 150;
    // an entry of the index weighs 100 in Sphinx, so that any function outranks every page
    if (kind === "index" || kind === "object") return title.toLowerCase().endsWith(`.${query}`) ? 40 : Math.min(score, 12);
    // all words of errors are on one page
    return name === "errors" || name === "changes" ? Math.min(score, 1) : score + (isReference ? 0 : 4);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
