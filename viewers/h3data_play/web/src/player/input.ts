/** Keys, mouse, touch and gamepad, made into what the player wants. */

import { clamp } from "../motion/sdf.ts";

export type Wish = "act" | "goto" | "turn" | "drop" | "give" | "sit" | "lie" | "wave" | "phone" | "chore" | "view" | "help" | "map" | "sound" | "cancel" | "use" | "do" | "talk" | "finish" | `perform${number}`;

export interface Listener {
  wish(wish: Wish): void;
  look(dyaw: number, dpitch: number): void;
  zoom(factor: number): void;
  /** A click or tap, in picture coordinates -1..1. */
  point(x: number, y: number): void;
}

const WALK: Record<string, "ahead" | "back" | "left" | "right" | "slow"> = {
  KeyW: "ahead", ArrowUp: "ahead", KeyS: "back", ArrowDown: "back",
  KeyA: "left", ArrowLeft: "left", KeyD: "right", ArrowRight: "right",
  ShiftLeft: "slow", ShiftRight: "slow",
};
const WISHES: Record<string, Wish> = {
  KeyE: "act", Space: "act", KeyF: "goto", KeyO: "turn", KeyQ: "drop", KeyG: "give", KeyC: "sit", KeyL: "lie", KeyX: "wave", KeyP: "phone", KeyK: "chore", KeyV: "view", KeyH: "help", KeyM: "map",
  KeyN: "sound", Escape: "cancel", KeyR: "use", KeyB: "do", KeyT: "talk",
};
const PAD_WISHES: Wish[] = ["act", "drop", "goto", "view", "turn"];

/** 2.5 m/s and 2.5 rad/s are hard to steer by keys. */
const SLOW = 0.35;
const BACKWARDS = 0.5;
/** A turn by keys begins gently, so that a tap turns by a few degrees. */
const GENTLE_MS = 140;
const GENTLE = 0.4;
const DEAD = 0.15;
/** A press that moves less than this is a click, px. */
const CLICK_PX = 6;

export class Input {
  /** Where the mouse is, in picture coordinates; null: it has left. */
  pointer: { x: number; y: number } | null = null;
  /** How the player acts now, for the hints: they name keys, buttons or taps. */
  device: "keys" | "mouse" | "touch" | "pad";
  /** When the player began to steer by keys, ms; 0: it has been shown since. */
  pressedAt = 0;
  private readonly held = new Set<string>();
  private turnedAt = 0;
  private stick = { forward: 0, turn: 0 };
  private pad = { forward: 0, turn: 0 };
  private padDown: boolean[] = [];
  private drag: { id: number; x: number; y: number; moved: boolean } | null = null;

  constructor(
    private readonly canvas: HTMLElement,
    private readonly listener: Listener,
    signal: AbortSignal,
  ) {
    this.device = matchMedia("(pointer: coarse)").matches ? "touch" : "keys";
    const until = { signal };
    addEventListener("keydown", (event) => this.keyDown(event), until);
    addEventListener("keyup", (event) => this.held.delete(event.code), until);
    // else a key stays down for ever when the window loses the focus
    addEventListener("blur", () => this.release(), until);
    document.addEventListener("visibilitychange", () => document.hidden && this.release(), until);
    canvas.addEventListener("pointerdown", (event) => this.pointerDown(event), until);
    canvas.addEventListener("pointermove", (event) => this.pointerMove(event), until);
    canvas.addEventListener("pointerup", (event) => this.pointerUp(event), until);
    canvas.addEventListener("pointercancel", () => (this.drag = null), until);
    canvas.addEventListener("pointerleave", () => (this.pointer = null), until);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault(), until);
    const closer = (event: WheelEvent): void => listener.zoom(event.deltaY > 0 ? 1.1 : 1 / 1.1);
    canvas.addEventListener("wheel", closer, { passive: true, signal });
  }

  release(): void {
    this.held.clear();
    this.stick = { forward: 0, turn: 0 };
  }

  /** The thumb on the stick of a touch screen, -1..1 each. */
  setStick(forward: number, turn: number): void {
    this.device = "touch";
    this.stick = { forward, turn };
  }

  /** Whether something is pressed that turns the body. */
  get turns(): boolean {
    return this.command().turn !== 0;
  }

  /** What the player steers now, -1..1 each. */
  command(): { forward: number; turn: number } {
    const down = (name: string): number => +[...this.held].some((code) => WALK[code] === name);
    const slow = down("slow") ? SLOW : 1;
    const sideways = down("left") - down("right");
    if (!sideways) this.turnedAt = 0;
    else this.turnedAt ||= performance.now();
    const gentle = sideways && performance.now() - this.turnedAt < GENTLE_MS ? GENTLE : 1;
    const forward = (down("ahead") - down("back") * BACKWARDS) * slow + this.stick.forward + this.pad.forward;
    const turn = sideways * Math.min(slow * 1.4, 1) * gentle + this.stick.turn + this.pad.turn;
    return { forward: clamp(forward, -1, 1), turn: clamp(turn, -1, 1) };
  }

  /** Reads the gamepad; the browser has no events for sticks. */
  poll(seconds: number): void {
    const pad = navigator.getGamepads?.().find((found) => found?.connected && found.mapping !== "xr-standard");
    if (!pad) {
      this.pad = { forward: 0, turn: 0 };
      return;
    }
    const axis = (k: number): number => {
      const value = pad.axes[k] ?? 0;
      return Math.abs(value) > DEAD ? value : 0;
    };
    this.pad = { forward: axis(1) > 0 ? -axis(1) * BACKWARDS : -axis(1), turn: -axis(0) };
    if (axis(2) || axis(3)) this.listener.look(-axis(2) * seconds * 2.4, -axis(3) * seconds * 1.6);
    PAD_WISHES.forEach((wish, k) => {
      const pressed = !!pad.buttons[k]?.pressed;
      if (pressed && !this.padDown[k]) this.listener.wish(wish);
      this.padDown[k] = pressed;
    });
    if (this.pad.forward || this.pad.turn || this.padDown.some(Boolean)) this.device = "pad";
  }

  private keyDown(event: KeyboardEvent): void {
    const target = event.target as HTMLElement;
    if (event.code === "Tab") document.body.dataset.tabs = ""; // from now on the focus is shown on the picture, too
    if (event.ctrlKey || event.metaKey || event.altKey || target.closest("input, textarea, select, dialog")) return;
    // Space and Enter press a button that has the focus
    if (event.code === "Space" && target.closest("button")) return;
    const digit = /^Digit([1-9])$/.exec(event.code)?.[1];
    const wish: Wish | undefined = digit ? `perform${Number(digit)}` : WISHES[event.code];
    if (wish || WALK[event.code]) this.device = "keys"; // Tab is for buttons, which a touch screen has, too
    if (WALK[event.code]) {
      if (!this.held.size) this.pressedAt = performance.now();
      this.held.add(event.code);
    }
    else if (wish && !event.repeat) this.listener.wish(wish);
    else return;
    // the page would scroll, or the box that has the focus now would get the letter
    if (event.code.startsWith("Arrow") || event.code === "Space" || wish === "talk") event.preventDefault();
  }

  private pointerDown(event: PointerEvent): void {
    if (this.drag) return;
    this.device = event.pointerType === "touch" ? "touch" : "mouse";
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({ preventScroll: true });
    this.drag = { id: event.pointerId, x: event.clientX, y: event.clientY, moved: false };
  }

  private pointerMove(event: PointerEvent): void {
    if (event.pointerType === "mouse") this.pointer = this.place(event);
    const drag = this.drag;
    if (!drag || drag.id !== event.pointerId) return;
    const dx = event.clientX - drag.x;
    const dy = event.clientY - drag.y;
    if (!drag.moved && Math.hypot(dx, dy) < CLICK_PX) return;
    drag.moved = true;
    drag.x = event.clientX;
    drag.y = event.clientY;
    this.listener.look(-dx * 0.0045, -dy * 0.0035);
  }

  private pointerUp(event: PointerEvent): void {
    const drag = this.drag;
    if (!drag || drag.id !== event.pointerId) return;
    this.drag = null;
    if (drag.moved || event.button === 2) return;
    const place = this.place(event);
    this.listener.point(place.x, place.y);
  }

  private place(event: PointerEvent): { x: number; y: number } {
    const box = this.canvas.getBoundingClientRect();
    return {
      x: ((event.clientX - box.left) / box.width) * 2 - 1,
      y: 1 - ((event.clientY - box.top) / box.height) * 2,
    };
  }
}

/** The stick that a thumb moves on a touch screen: a ring with a knob. */
export class Stick {
  private touch = -1;

  constructor(
    private readonly ring: HTMLElement,
    private readonly knob: HTMLElement,
    private readonly input: Input,
  ) {
    ring.addEventListener("pointerdown", (event) => {
      this.touch = event.pointerId;
      ring.setPointerCapture(event.pointerId);
      this.move(event);
    });
    ring.addEventListener("pointermove", (event) => event.pointerId === this.touch && this.move(event));
    for (const end of ["pointerup", "pointercancel"] as const) ring.addEventListener(end, () => this.rest());
  }

  private move(event: PointerEvent): void {
    const box = this.ring.getBoundingClientRect();
    const radius = box.width / 2;
    let x = (event.clientX - box.left) / radius - 1;
    let y = (event.clientY - box.top) / radius - 1;
    const length = Math.hypot(x, y);
    if (length > 1) [x, y] = [x / length, y / length];
    this.knob.style.translate = `${x * radius * 0.6}px ${y * radius * 0.6}px`;
    const dead = (value: number): number => (Math.abs(value) < 0.18 ? 0 : value);
    this.input.setStick(y > 0 ? -dead(y) * BACKWARDS : -dead(y), -dead(x) * 0.8);
  }

  private rest(): void {
    this.touch = -1;
    this.knob.style.translate = "";
    this.input.setStick(0, 0);
  }
}
