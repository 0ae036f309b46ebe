/** Tells the server of a study when the participant turns to another window and when they are back. */

import { post } from "../link/flow.ts";

let since = 0;
let logs = false;

function note(away: boolean): void {
  if (away === since > 0) return;
  const ms = away ? 0 : performance.now() - since;
  since = away ? performance.now() : 0;
  const why = document.visibilityState === "hidden" ? "hidden" : "blur";
  // a page that is being closed or put away may still send this; what gets lost is only the log's
  void post("api/study/focus", { away, why, ms: Math.round(ms) }, { keepalive: true }).catch(() => undefined);
}

/** Begins, once. */
export function logFocus(): void {
  if (logs) return;
  logs = true;
  addEventListener("blur", () => note(true));
  addEventListener("focus", () => note(false));
  document.addEventListener("visibilitychange", () => note(document.visibilityState === "hidden" || !document.hasFocus()));
}
