/** Colours that people with any colour vision tell apart (Okabe and Ito 2008), each with a letter of its own. */

export const THINGS = ["#e69f00", "#56b4e9", "#cc79a7", "#f0e442", "#d55e00", "#009e73"] as const;
export const YOU = "#0072b2";
export const ROBOT = "#d55e00";
export const OTHER = "#cc79a7";
export const OK = "#009e73";
/** Doors and drawers. */
export const JOINT = "#e8edf2";
export const BAD = "#d55e00";

/** The place that the app marks has the number -1. */
export const MARKER = -1;
export const thingColor = (k: number): string => (k === MARKER ? "#ffffff" : THINGS[k % THINGS.length]!);
export const thingLetter = (k: number): string => (k === MARKER ? "◎" : String.fromCharCode(65 + (k % 26)));
