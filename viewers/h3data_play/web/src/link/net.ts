/** The socket: states in, raw input out, the server's clock, reconnecting to the same seat. */

import { decodePong, decodeState, type AgentLayout, type State } from "./wire.ts";

export type Link = "connecting" | "open" | "lost" | "paused" | "closed";

export interface NetListener {
  state(state: State): void;
  /** A text frame that is no state: hud, why, over, ... */
  told(message: Record<string, unknown>): void;
  /** `why` is for the player, of a link that stays closed. */
  link(link: Link, why: string): void;
}

export interface NetOptions {
  url: string;
  agents: AgentLayout[];
  stepMs: number;
  /** Delays both directions by half of it, for tests, ms. */
  lagMs?: number;
}

/** Close codes after which another try is of no use, as sentences. */
const FINAL: Record<number, string> = {
  1003: "The server did not understand this page. Reload it; if that does not help, the page and the server are of different versions.",
  1008: "The server has closed this place: too many messages came from this page.",
  4001: "You have opened this session in another tab. It goes on there.",
  4003: "This place has been given to somebody else, or the session has ended.",
};
const KEPT_STATES = 60;
const FIRST_RETRY_MS = 250;
const MOST_RETRY_MS = 3000;
const PING_MS = 500;
const KEPT_TRIPS = 8;
/** No state for so long: the clock of the session may have stood still. */
const PAUSE_MS = 600;
/** No word from the server for so long: the link is dead, even if the browser has not noticed. */
const SILENT_MS = 4000;
/** A message arrives a little later than half of a round trip at times; it is meant for a step that much later. */
const FIRST_MARGIN_MS = 6;
const MOST_MARGIN_MS = 60;

export class Net {
  readonly states: State[] = [];
  rtt = 0;
  bytes = 0;
  received = 0;
  connects = 0;
  /** Number of the next message. */
  seq = 0;
  readonly ackDelays: number[] = [];
  private socket: WebSocket | undefined;
  private link: Link = "connecting";
  private retry = FIRST_RETRY_MS;
  private offset = Infinity;
  private heardAt = performance.now();
  private beatAt = performance.now();
  private stateAt = -Infinity;
  private readonly trips: number[] = [];
  private margin = FIRST_MARGIN_MS;
  private readonly inFlight: { seq: number; at: number; step: number }[] = [];
  private readonly rates: number[] = [];

  constructor(
    private readonly options: NetOptions,
    private readonly listener: NetListener,
  ) {
    this.connect();
    const beat = setInterval(() => (this.link === "closed" ? clearInterval(beat) : this.beat()), PING_MS);
  }

  get latest(): State | undefined {
    return this.states.at(-1);
  }

  /** States that came in the last second. */
  get statesPerSecond(): number {
    const since = performance.now() - 1000;
    while (this.rates.length && this.rates[0]! < since) this.rates.shift();
    return this.rates.length;
  }

  /** Clock of the server [ms] of the newest state that could have arrived by now. */
  get clock(): number {
    return performance.now() - this.offset;
  }

  /** Steps after the latest state in which a message sent now would act; a fraction counts. */
  get ahead(): number {
    const state = this.latest;
    return state ? (this.clock + this.rtt + this.margin - state.clockMs) / this.options.stepMs : 0;
  }

  /** Sends a message to be kept to the letter; returns its number and the step that it is meant for. */
  send(message: Record<string, unknown>): { seq: number; step: number } {
    const at = performance.now();
    const step = (this.latest?.step ?? 0) + Math.floor(this.ahead) + 1;
    const seq = this.seq++;
    this.write(JSON.stringify({ ...message, seq, step, ct: round(at), rtt: round(this.rtt) }));
    this.inFlight.push({ seq, at, step });
    if (this.inFlight.length > 128) this.inFlight.shift();
    return { seq, step };
  }

  /** Sends a question, which changes nothing and is not recorded. */
  ask(message: Record<string, unknown>): void {
    this.write(JSON.stringify(message));
  }

  /** Cuts the connection, as a bad network does; it is made again. */
  drop(): void {
    this.socket?.close(4000);
  }

  /** Lets go of the link until `resume`; the world stands still meanwhile. */
  pause(): void {
    this.link = "paused";
    this.socket?.close(1000);
  }

  resume(): void {
    if (this.link !== "paused") return;
    this.link = "connecting";
    this.connect();
  }

  /** Ends the link for good. */
  close(why: string): void {
    this.become("closed", why);
    this.socket?.close(1000);
  }

  private connect(): void {
    const socket = new WebSocket(this.options.url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.connects++;
      this.heardAt = performance.now();
      // another worker may have another clock
      this.offset = Infinity;
      this.states.length = this.inFlight.length = 0;
      this.ping();
    };
    socket.onmessage = (event: MessageEvent<ArrayBuffer | string>) => {
      const lag = this.options.lagMs ?? 0;
      if (lag) setTimeout(() => this.hear(event.data), lag / 2);
      else this.hear(event.data);
    };
    socket.onclose = (event) => {
      if (this.socket !== socket || this.link === "closed" || this.link === "paused") return;
      const why = FINAL[event.code];
      if (why) {
        this.become("closed", why);
        return;
      }
      this.become("lost", "");
      setTimeout(() => this.link === "lost" && this.connect(), this.retry);
      this.retry = Math.min(this.retry * 1.7, MOST_RETRY_MS);
    };
    this.socket = socket;
  }

  private hear(data: ArrayBuffer | string): void {
    const now = performance.now();
    this.heardAt = now;
    if (typeof data === "string") {
      this.listener.told(JSON.parse(data) as Record<string, unknown>);
      return;
    }
    this.bytes += data.byteLength;
    const pong = decodePong(data);
    if (pong) {
      // the least of some seconds: a frame that takes long delays the answer, not the connection
      this.trips.push(now - pong.clientMs);
      if (this.trips.length > KEPT_TRIPS) this.trips.shift();
      this.rtt = Math.min(...this.trips);
      return;
    }
    const state = decodeState(data, this.options.agents, this.latest);
    // the state that came fastest tells the offset; it is let go slowly, because clocks drift, and at once after a pause
    const drift = now - this.stateAt > PAUSE_MS ? Infinity : 0.02;
    this.offset = Math.min(this.offset + drift, now - state.clockMs);
    this.stateAt = now;
    this.noteAcks(state, now);
    // after a reload the numbers go on where the page before has stopped
    this.seq = Math.max(this.seq, state.ack + 1);
    this.received++;
    this.rates.push(now);
    this.states.push(state);
    if (this.states.length > KEPT_STATES) this.states.shift();
    if (this.link !== "open") {
      this.retry = FIRST_RETRY_MS;
      this.become("open", "");
    }
    this.listener.state(state);
  }

  /** Messages that acted later than in the step that they were meant for ask for more margin; time takes it back. */
  private noteAcks(state: State, now: number): void {
    let late = false;
    while (this.inFlight.length && this.inFlight[0]!.seq <= state.ack) {
      const sent = this.inFlight.shift()!;
      this.ackDelays.push(now - sent.at);
      late ||= state.step > sent.step && this.states.length > 0 && this.latest!.step === state.step - 1;
    }
    if (this.ackDelays.length > 1500) this.ackDelays.shift();
    this.margin = late ? Math.min(this.margin + 8, MOST_MARGIN_MS) : Math.max(this.margin - 0.01, FIRST_MARGIN_MS);
  }

  private beat(): void {
    const now = performance.now();
    // a page that was busy itself has not listened either
    if (now - this.beatAt > 2 * PING_MS) this.heardAt = now;
    this.beatAt = now;
    if (this.link === "open" && now - this.heardAt > SILENT_MS) {
      this.drop();
      return;
    }
    this.ping();
  }

  private ping(): void {
    this.write(JSON.stringify({ k: "ping", ct: performance.now() }));
  }

  private write(text: string): void {
    const socket = this.socket;
    if (socket?.readyState !== WebSocket.OPEN) return;
    const lag = this.options.lagMs ?? 0;
    if (lag) setTimeout(() => socket.readyState === WebSocket.OPEN && socket.send(text), lag / 2);
    else socket.send(text);
  }

  private become(link: Link, why: string): void {
    if (this.link === link) return;
    this.link = link;
    this.listener.link(link, why);
  }
}

const round = (value: number): number => Math.round(value * 10) / 10;
