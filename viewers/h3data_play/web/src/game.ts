/** A session as it is played: what is pressed becomes messages, states become pictures, reasons become sentences. */

import { Vector3, WebGLRenderer } from "three";
import {
  actKeys, busyHints, choreHints, deed, heldBy, hints, holderText, postureHints, situation, thumbText, useKey, type Barriers, type Chore, type Seen, type Situation,
} from "./player/actions.ts";
import { CameraRig, type View } from "./scene/camera.ts";
import { Cues } from "./screen/cues.ts";
import { Deeds } from "./screen/deeds.ts";
import { Talk } from "./screen/talk.ts";
import { Headset } from "./headset/xr.ts";
import { discsOf, type Base, type Driving } from "./motion/drive.ts";
import type { Hud, TodoItem } from "./screen/hud.ts";
import { Input, Stick, type Wish } from "./player/input.ts";
import type { Manifest } from "./link/manifest.ts";
import type { Net } from "./link/net.ts";
import { Pointing } from "./scene/pointing.ts";
import { Predictor } from "./motion/predict.ts";
import type { Sdf } from "./motion/sdf.ts";
import { Sound } from "./player/sound.ts";
import { Steering } from "./motion/steering.ts";
import { FLAG, type State } from "./link/wire.ts";
import { isOpen } from "./scene/joints.ts";
import { between, type World } from "./scene/world.ts";
import { say } from "./words.ts";

/** Others are shown this late, so that there are two states to go between. */
const LATE_MS = 50;
/** The server is asked about a place at most this often. */
const ASK_MS = 120;
/** A place is another one from here on, m. */
const ASK_M = 0.01;

/** Who drives a robot looks over its back. */
const EYE_M = 1.55;
const ROBOT_EYE_M = 1.05;
const SLOW_MS = 40;
const SLOW_FRAMES = 20;
const LEAST_RATIO = 0.5;
/** From here something can be cleaned, filled, poured out or switched, m. */
const USE_M = 1.5;

export class Game {
  readonly camera: CameraRig;
  readonly renderer: WebGLRenderer;
  readonly sound = new Sound();
  readonly input: Input;
  readonly predictor: Predictor | null = null;
  readonly frameMs: number[] = [];
  /** From a key to the picture in which the own body moves. */
  readonly keyMs: number[] = [];
  /** Where the player's body is shown. */
  shown: Base = { x: 0, z: 0, heading: 0 };
  now: Situation | null = null;
  /** What has to be opened first, as the server has told. */
  barriers: Barriers = [];
  /** Where the player has seen each thing; null: they know where everything is. */
  seen: Seen | null = null;
  /** What the person can do now with the things that they brought along, as the server has told. */
  chores: Chore[] = [];
  frames = 0;
  headset: Headset | null = null;
  readonly talk: Talk;
  readonly deeds: Deeds;
  private readonly cues: Cues;
  private readonly pointing: Pointing;
  private readonly steering: Steering | null = null;
  private before = performance.now();
  private held = -1;
  private aim: { point: Vector3; fits: boolean | null; why: string; askedAt: number } | null = null;
  private walkTo: Vector3 | null = null;
  private ended = false;
  /** Whether a person is played: only they sit down, drop things and hand them over. */
  private readonly person: boolean;
  private readonly acts: string[];
  /** Whether there is anything for hands in this home. */

  private readonly life = new AbortController();

  constructor(
    readonly manifest: Manifest,
    readonly world: World,
    readonly sdf: Sdf,
    readonly net: Net,
    private readonly hud: Hud,
    options: { antialias: boolean; pixelRatio: number; renderer?: WebGLRenderer },
  ) {
    const { signal } = this.life;
    const { origin, shape, cell } = manifest.sdf;
    const [x1, z1] = [origin[0] + shape[0] * cell, origin[1] + shape[1] * cell];
    const eye = manifest.agents[manifest.me]?.kind === "robot" ? ROBOT_EYE_M : EYE_M;
    this.camera = new CameraRig(world.floor.highest, eye, [origin[0], origin[1], x1, z1]);
    // one that is there shows the episode before, in a headset that is still worn
    this.renderer = options.renderer ?? new WebGLRenderer({ canvas: hud.canvas, antialias: options.antialias });
    if (!options.renderer) this.renderer.setPixelRatio(options.pixelRatio);
    this.cues = new Cues(world, manifest, sdf, hud.marks, hud.map);
    this.pointing = new Pointing(world);
    this.talk = new Talk(manifest, (text) => this.net.send({ k: "say", text }), signal);
    this.deeds = new Deeds(manifest, (message) => this.net.send(message), hud, signal);
    const agent = manifest.agents[manifest.me];
    if (agent) {
      this.predictor = new Predictor(sdf, agent.drive, manifest.dt);
      const sink = { sendMove: (f: number, t: number) => this.sendMove(f, t) };
      this.steering = new Steering(sink, this.predictor, agent.drive, manifest.dt);
    }
    this.input = new Input(hud.canvas, {
      wish: (wish) => this.wish(wish),
      look: (dyaw, dpitch) => this.camera.look(dyaw, dpitch),
      zoom: (factor) => this.camera.zoom(factor),
      point: (x, y) => this.point(x, y),
    }, signal);
    new Stick(hud.ring, hud.knob, this.input);
    hud.on("button-leave", () => hud.askToLeave(() => this.net.send({ k: "leave" })), signal);
    hud.show("button-leave", agent !== undefined);
    this.acts = agent?.acts ?? [];
    hud.acts(this.acts, (number) => this.wish(`perform${number}`));
    for (const [button, wish] of BUTTONS) hud.on(button, () => this.wish(wish), signal);
    hud.on("button-talk", () => this.talk.toggle(), signal);
    if (agent) void this.offerHeadset(agent.drive);
    const robot = manifest.agents.some((other, k) => other.kind === "robot" && k !== manifest.me);
    this.person = agent?.kind === "human";
    const things = !!agent && manifest.objects.length > 0;
    const joints = !!agent && manifest.joints.length > 0;
    const chores = this.person && manifest.brought?.some(({ name }) => name.startsWith(`${agent.name}_`)) === true;
    hud.offers({ things, joints, person: this.person, acts: this.acts, robot, places: things && manifest.spots.length > 0, talk: manifest.phrases.length > 0, chores });
    this.setView(agent ? "third" : "above");
    addEventListener("resize", () => this.resize(), { signal });
    this.resize();
  }

  /** Aborts when the episode is left. */
  get signal(): AbortSignal {
    return this.life.signal;
  }

  /** Lets go of the page and of the graphics card's memory; the renderer stays. */
  leave(): void {
    this.life.abort();
    this.net.close("");
    this.world.dispose();
  }

  // --- from the server ----------------------------------------------------------------------------------------------
  hear(state: State): void {
    const me = this.manifest.me;
    const base = state.agents[me];
    if (!base) return;
    if (this.predictor) {
      this.predictor.hear({ step: state.step, ack: state.ack, base }, (state.flags & FLAG.busy) !== 0);
      this.predictor.others = state.agents.flatMap((at, k) => (k === me ? [] : discsOf(at, this.manifest.agents[k]!.drive)));
    }
    const held = heldBy(this.manifest, state, me);
    if (held !== this.held) this.sound.play(held >= 0 ? "take" : "put");
    this.held = held;
    if (this.walkTo && !(state.flags & FLAG.busy) && this.arrived(base)) this.stopWalkingTo();
  }

  answer(point: number[], why: string): void {
    const aim = this.aim;
    if (!aim || Math.hypot(aim.point.x - point[0]!, aim.point.z - point[2]!) > ASK_M) return;
    aim.fits = !why;
    aim.why = why;
  }

  /** A point of the floor that the app wants to be seen; null: none. */
  mark(point: [number, number, number] | null): void {
    this.cues.mark(point && new Vector3(...point));
  }

  refused(why: string): void {
    this.hud.toast(why);
    this.sound.play("refused");
    this.stopWalkingTo();
  }

  reconnected(): void {
    this.steering?.reset();
    this.input.release();
  }

  over(success: boolean): void {
    this.ended = true;
    if (success) this.sound.play("done");
  }

  // --- from the player ----------------------------------------------------------------------------------------------
  wish(wish: Wish): void {
    if (wish === "view") this.setView(NEXT_VIEW[this.camera.view]);
    else if (wish === "help") this.hud.toggleHelp();
    else if (wish === "map") this.hud.toggleMap();
    else if (wish === "talk" && this.manifest.phrases.length) this.talk.toggle(true);
    else if (wish === "finish") this.deeds.askToFinish();
    else if (wish === "sound") this.hud.pressed("button-sound", this.sound.toggle());
    else if (this.now && !this.ended) this.doSomething(wish, this.now);
  }

  private doSomething(wish: Wish, now: Situation): void {
    const act = /^perform(.)$/.exec(wish)?.[1];
    if (act) this.perform(this.acts[Number(act) - 1]);
    else if (wish === "cancel") this.stopWalkingTo(true);
    else if (wish === "do") this.deeds.open(now.held >= 0 ? now.held : now.next);
    else if (wish === "use") this.use(now);
    else if (wish === "drop" || wish === "give") this.letGo(wish, now);
    else if (wish === "chore") this.chore();
    else if (wish === "sit" || wish === "lie" || wish === "wave" || wish === "phone") this.assume(wish);
    else if (wish === "turn") {
      if (now.joint >= 0) this.turn(now.joint);
      else this.hud.toast(say("nothing_opens"));
    } else if (wish === "act" || wish === "goto") this.handle(now, wish === "goto");
  }

  private assume(wish: "sit" | "lie" | "wave" | "phone"): void {
    if (!this.person) this.hud.toast(say(wish === "sit" ? "no_sitting" : "no_posture"));
    else if (wish === "sit" || wish === "lie") this.net.send({ k: "sit", lies: wish === "lie" });
    else this.net.send({ k: "gesture", name: wish });
  }

  /** Performs a motion of a file, or ends it. */
  private perform(name: string | undefined): void {
    if (name) this.net.send({ k: "perform", name });
    else this.hud.toast(say("no_posture"));
  }

  /** Takes or puts down a thing that the person brought along. */
  private chore(): void {
    const chore = this.chores.find(({ name }) => name !== "phone");
    if (chore) this.net.send({ k: "chore", name: chore.name });
    else this.hud.toast(say("no_chore"));
  }

  private letGo(wish: "drop" | "give", now: Situation): void {
    if (!this.manifest.objects.length) this.hud.toast(say("nothing_to_take"));
    else if (now.held < 0) this.refused(say("empty_hand"));
    else if (wish === "drop") this.net.send({ k: "drop" });
    // the server says to a robot that it hands nothing over
    else if (now.robot >= 0 || !this.person) this.net.send({ k: "give", a: Math.max(now.robot, 0) });
    else this.refused(say("no_robot"));
  }

  /** Takes the next thing, opens what it is in, or puts down what is held; with `lead`, walks there first. */
  private handle(now: Situation, lead: boolean): void {
    const next = deed(now, lead);
    if (next.kind === "put") {
      const aim = lead ? null : this.aim;
      const goal = this.manifest.goals[now.held];
      if (aim && aim.fits === false) this.refused(aim.why);
      else if (aim) this.net.send({ k: "place", p: numbers(aim.point) });
      else if (goal) this.net.send({ k: "place", p: goal.position, lead });
      else this.deeds.open(now.held);
    } else if (next.kind === "turn") this.turn(next.joint);
    else if (next.kind === "take") this.net.send({ k: "pick", o: next.thing, lead });
    else if (now.known.some((at, k) => !at && !now.done[k])) this.hud.toast(say("look_for_it"));
    else this.hud.toast(say(this.manifest.goals.length ? "all_there" : "nothing_to_take"));
  }

  /** Cleans, fills, pours out or switches what is held or near. */
  private use(now: Situation): void {
    const thing = this.useful(now);
    if (thing >= 0) this.net.send({ k: "use", o: thing, lead: true });
  }

  private useful(now: Situation): number {
    return this.deeds.useful(this.net.latest!, now.held, this.shown, USE_M);
  }

  /** Opens or closes a door or drawer, and walks there first. */
  private turn(joint: number): void {
    const shut = !isOpen(this.manifest.joints[joint]!, this.net.latest!.joints[joint]!);
    this.net.send({ k: shut ? "open" : "close", j: joint, lead: true });
  }

  private point(x: number, y: number): void {
    if (!this.now || this.ended || !this.steering) return;
    const [px, py] = document.pointerLockElement ? [0, 0] : [x, y];
    const target = this.pointing.target(px, py, this.camera.camera, this.now.held);
    const agent = this.pointing.agent(px, py, this.camera.camera);
    if (agent >= 0) {
      // somebody stands before what is there: not what was meant, and no place to walk to
      if (this.now.held >= 0 && this.manifest.agents[agent]!.kind === "robot" && agent !== this.manifest.me) this.wish("give");
    } else if (target.kind === "thing" && this.now.held < 0) this.net.send({ k: "pick", o: target.thing, lead: true });
    else if (target.kind === "joint") this.turn(target.joint);
    else if (target.kind === "top" && this.now.held >= 0)
      this.net.send({ k: "place", p: this.standing(target.point), lead: true });
    else if (target.kind === "floor") {
      this.walkTo = target.point;
      this.cues.walkingTo(target.point);
      this.net.send({ k: "goto", p: numbers(target.point) });
    }
  }

  private sendMove(forward: number, turn: number): { seq: number; step: number } {
    if (forward || turn) this.stopWalkingTo();
    return this.net.send({ k: "move", f: forward, t: turn });
  }

  private stopWalkingTo(tell = false): void {
    if (tell) this.net.send({ k: "stop" });
    this.walkTo = null;
    this.cues.walkingTo(null);
  }

  private arrived(base: Base): boolean {
    return !!this.walkTo && Math.hypot(this.walkTo.x - base.x, this.walkTo.z - base.z) < 0.35;
  }

  /** Where the origin of what is held comes to be if it stands on a point. */
  private standing(point: Vector3): number[] {
    const up = this.held >= 0 ? -this.cues.low(this.held) : 0;
    return numbers(new Vector3(point.x, point.y + up + 0.002, point.z));
  }

  // --- every frame --------------------------------------------------------------------------------------------------
  frame(frame?: XRFrame): void {
    const time = performance.now();
    const seconds = Math.min((time - this.before) / 1000, 0.2);
    this.frameMs.push(time - this.before);
    if (this.frameMs.length > 600) this.frameMs.shift();
    this.before = time;
    const state = this.net.latest;
    if (!state || !this.net.states.length) {
      this.renderer.render(this.world.scene, this.camera.camera);
      return;
    }
    this.input.poll(seconds);
    const plays = !this.ended && this.hud.playing;
    if (this.headset?.on && frame && this.frames) {
      const busy = (state.flags & FLAG.busy) !== 0;
      this.headset.frame(frame, this.shown, busy, plays, this.hud.words(), seconds);
    }
    if (plays) this.steer();
    const [a, b, share] = this.span(this.net.clock - LATE_MS);
    const was = this.shown;
    this.place(state, a, b, share, seconds);
    const steps = this.input.pressedAt > 0 && Math.abs(was.x - this.shown.x) + Math.abs(was.heading - this.shown.heading) > 1e-4;
    this.world.pose(a, b, share, this.manifest.me, this.steering ? this.shown : null);
    if (this.steering) this.camera.floorY = this.world.floor.height(this.shown.x, this.shown.z);
    if (!this.headset?.on) this.camera.follow(this.shown, this.world.solid, seconds);
    this.world.showBody(this.manifest.me, this.headset?.on || !this.camera.hidesBody);
    this.world.showHead(this.manifest.me, !this.headset?.on && this.camera.view !== "first");
    this.now = situation(this.manifest, state, this.manifest.me, this.shown, this.barriers, this.world.joints.handles, this.seen);
    this.preview(this.now);
    this.cues.draw(state, this.now, this.manifest.me, this.shown, this.camera.camera, this.camera.yaw, this.talk.bubbles);
    this.tell(state, this.now);
    this.coarsen(); // before the picture: a canvas of another size is empty
    this.renderer.render(this.world.scene, this.camera.camera);
    if (steps) {
      this.keyMs.push(performance.now() - this.input.pressedAt);
      this.input.pressedAt = 0;
    }
    if (!this.frames++) performance.mark("first-frame");
  }

  private steer(): void {
    if (this.headset?.on) this.steering?.send(this.headset.command);
    else this.steering?.steer(this.input.command(), this.camera, this.shown.heading);
  }

  /** Where the own body is: predicted while the player steers it, else as late as everybody. */
  private place(state: State, a: State, b: State, share: number, seconds: number): void {
    const me = this.manifest.me;
    if (!this.predictor || !this.steering) return;
    const busy = (state.flags & (FLAG.busy | FLAG.ended)) !== 0;
    const told = { step: state.step, ack: state.ack, base: state.agents[me]! };
    const target = busy ? between(a.agents[me]!, b.agents[me]!, share) : this.predictor.at(told, this.net.ahead);
    this.shown = this.predictor.smooth(target, this.steering.command, !busy, seconds);
  }

  private span(clock: number): [State, State, number] {
    const states = this.net.states;
    let k = states.length - 1;
    while (k > 0 && states[k - 1]!.clockMs > clock) k--;
    const a = states[Math.max(k - 1, 0)]!;
    const b = states[k]!;
    const long = b.clockMs - a.clockMs;
    return [a, b, long > 0 ? Math.min(Math.max((clock - a.clockMs) / long, 0), 1) : 1];
  }

  /** Shows where what is held would stand, at the pointer or else at its goal, and asks the server whether it may. */
  private preview(now: Situation): void {
    const point = now.held >= 0 ? this.placeAimedAt(now) : null;
    if (!point) this.aim = null;
    else if (!this.aim || this.aim.point.distanceTo(point) > ASK_M)
      this.aim = { point, fits: null, why: "", askedAt: this.aim?.askedAt ?? 0 };
    this.cues.preview(now.held, point, this.aim?.fits ?? null);
    if (this.aim && this.aim.fits === null && performance.now() - this.aim.askedAt > ASK_MS) {
      this.aim.askedAt = performance.now();
      this.net.ask({ k: "can", p: numbers(this.aim.point) });
    }
  }

  private placeAimedAt(now: Situation): Vector3 | null {
    const pointer = this.input.pointer;
    if (pointer && this.input.device !== "touch" && this.input.device !== "pad") {
      const target = this.pointing.target(pointer.x, pointer.y, this.camera.camera, now.held);
      if (target.kind === "top" && Math.hypot(target.point.x - this.shown.x, target.point.z - this.shown.z) < 1.6)
        return new Vector3(...(this.standing(target.point) as [number, number, number]));
    }
    const goal = this.manifest.goals[now.held];
    return goal && now.far < 1.6 ? new Vector3(...goal.position) : null;
  }

  private tell(state: State, now: Situation): void {
    this.hud.device(this.input.device);
    this.hud.link(this.net.rtt, this.net.statesPerSecond);
    this.hud.time(state.step * this.manifest.dt);
    const plays = this.steering && !this.ended;
    const { device } = this.input;
    const useful = this.useful(now);
    const use: [string, string][] =
      useful < 0 || !useKey(device) ? [] : [[useKey(device), say(`use_${this.deeds.uses[useful]}`, { thing: this.manifest.objects[useful]!.label })]];
    const can = [...hints(now, this.manifest, state, device, this.aim?.fits ?? null), ...choreHints(this.chores, device), ...use];
    const rest = this.person ? postureHints(state.flags, device, this.acts) : [];
    const busy = [...busyHints(device), ...(state.flags & FLAG.seated ? rest : [])];
    const free = can.length ? [...can, ...(state.flags & FLAG.gestures && device === "keys" ? actKeys(this.acts) : [])] : rest;
    this.hud.hint(!plays ? [] : state.flags & FLAG.busy ? busy : free, device);
    this.hud.todo(this.manifest.goals.map((goal, k): TodoItem => {
      const who = holderText(this.manifest, state.things[k]!.held);
      const item = { thing: k, name: this.manifest.objects[k]!.label, done: now.done[k]! };
      const where = say(!now.known[k] ? "unseen_to_goal" : now.shut[k] ? "shut_to_goal" : "to_goal", { goal: goal.label });
      return { ...item, state: item.done ? say("there") : (now.known[k] && who) || where };
    }));
    this.hud.postures(plays ? state.flags : 0, plays ? this.chores : []);
    this.hud.thumb(...([false, true].map((lead) => thumbText(this.manifest, state, deed(now, lead), lead)) as [string, string]));
  }

  private async offerHeadset(drive: Driving): Promise<void> {
    if (!(await Headset.supported())) return;
    const player = {
      act: () => this.now && this.handle(this.now, true),
      drop: () => this.wish("drop"),
      goOn: () => this.hud.pressCover(),
      send: (message: Record<string, unknown>) => this.net.send(message),
    };
    const speed = { forward: drive.speed, turn: drive.turn, step: this.manifest.dt };
    const { signal } = this.life;
    const headset = new Headset(this.renderer, this.camera.camera, this.world.floor, speed, player, signal);
    this.world.scene.add(headset.rig);
    this.headset = headset;
    this.hud.show("button-vr", true);
    const enter = (): Promise<void> =>
      headset.enter(() => this.resize()).catch((error: Error) => this.hud.toast(say("headset_failed", { reason: error.message })));
    this.hud.on("button-vr", () => void enter(), signal);
    if (headset.on) headset.wear(() => this.resize());
  }

  setView(view: View): void {
    this.camera.view = view;
    this.world.showLids(view !== "above");
    this.hud.view(view);
  }

  /** Where frames take long, the picture gets coarser: who waits for pictures plays worse than who sees fewer pixels. */
  private coarsen(): void {
    if (this.frames % SLOW_FRAMES || !this.frames || this.headset?.on) return;
    const recent = this.frameMs.slice(-SLOW_FRAMES).sort((a, b) => a - b);
    const ratio = this.renderer.getPixelRatio();
    if (recent[SLOW_FRAMES >> 1]! > SLOW_MS && ratio > LEAST_RATIO) {
      this.renderer.setPixelRatio(Math.max(ratio * 0.75, LEAST_RATIO));
      this.resize();
    }
  }

  private resize(): void {
    if (this.renderer.xr.isPresenting) return;
    this.renderer.setSize(innerWidth, innerHeight, false);
    this.camera.resize(innerWidth, innerHeight);
  }
}

const BUTTONS: [string, Wish][] = [
  ["button-view", "view"], ["button-map", "map"], ["button-sound", "sound"], ["button-help", "help"],
  ["thumb-act", "act"], ["thumb-goto", "goto"], ["posture-sit", "sit"], ["posture-lie", "lie"], ["posture-wave", "wave"], ["posture-phone", "phone"], ["posture-chore", "chore"],
  ["button-do", "do"], ["button-finish", "finish"],
];
const NEXT_VIEW: Record<View, View> = { third: "first", first: "third", above: "above" };

/** To the tenth of a millimetre: what is recorded is read by people. */
const numbers = (point: Vector3): number[] => point.toArray().map((value) => Math.round(value * 1e4) / 1e4);
