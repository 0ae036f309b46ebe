/** The home as it is shown: nodes of its GLB, moved by states. */

import {
  Bone,
  Box3,
  CanvasTexture,
  Color,
  DirectionalLight,
  Group,
  HemisphereLight,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshLambertMaterial,
  PlaneGeometry,
  Quaternion,
  Scene,
  Vector3,
  type MeshStandardMaterial,
  type Object3D,
  type SkinnedMesh,
} from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import type { Base } from "../motion/drive.ts";
import type { Stage, StagedAgent } from "../link/manifest.ts";
import { Floor } from "../motion/floor.ts";
import { wrapAngle } from "../motion/sdf.ts";
import { JointRig } from "./joints.ts";
import { RobotRig } from "./robot.ts";
import type { PersonState, RobotState, State } from "../link/wire.ts";

const UP = new Vector3(0, 1, 0);
const SHADOW_M = 0.42;

/** A person's joints in the order of the state: the pelvis, then those that move. */
interface PersonRig {
  bones: (Bone | undefined)[];
  meshes: Object3D[];
  halves: HalfJoint[];
}

/** A bone that is turned half as far as a joint, from the joint's rotation at rest; skin follows it, so that bent joints keep their volume. */
interface HalfJoint {
  half: Bone;
  joint: Bone;
  rest: Quaternion;
}

export class World {
  readonly scene = new Scene();
  readonly things: Object3D[];
  /** How many of the things are objects of the task, which come first; only they are picked. */
  readonly pickable: number;
  readonly joints: JointRig;
  readonly floor: Floor;
  /** What a camera may not pass, and what a click on the floor may hit. */
  readonly solid: Object3D[] = [];
  readonly floors: Object3D[] = [];
  /** Everything that stands still and can carry a thing. */
  readonly home: Object3D[] = [];
  /** Hidden for those who look from above. */
  private readonly lids: Object3D[] = [];
  private readonly rigs: (RobotRig | PersonRig)[];
  private readonly shadows: Mesh[];
  private readonly named = new Map<string, Object3D>();
  private readonly turn = new Quaternion();
  private readonly swing = new Quaternion();
  private readonly from = new Vector3();

  static async load(glb: ArrayBuffer, manifest: Stage): Promise<World> {
    const file = await new GLTFLoader().parseAsync(glb, "");
    return new World(file.scene, manifest);
  }

  /** Frees what the graphics card holds of it. */
  dispose(): void {
    this.scene.traverse((node) => {
      if (!("isMesh" in node)) return;
      const { geometry, material } = node as Mesh;
      geometry.dispose();
      for (const one of [material].flat()) {
        (one as MeshBasicMaterial).map?.dispose();
        one.dispose();
      }
    });
  }

  private constructor(
    root: Group,
    private readonly manifest: Stage,
  ) {
    this.floor = new Floor(manifest.heights, manifest.floor_y);
    this.scene.background = new Color(0xdfe6ec);
    this.scene.add(root, ...lights());
    for (const node of root.children) this.sort(node, node.userData.name ?? node.name);
    root.traverse((node) => {
      const name: string = node.userData.name ?? node.name;
      if (!this.named.has(name)) this.named.set(name, node);
      // a skinned mesh is culled by where it was made, not by where its bones are
      if ("isSkinnedMesh" in node) node.frustumCulled = false;
      if ("isMesh" in node) (node as Mesh).material = matt((node as Mesh).material as MeshStandardMaterial);
    });
    this.pickable = manifest.objects.length;
    this.things = [...manifest.objects, ...(manifest.brought ?? [])].map((thing) => {
      const node = this.named.get(thing.name);
      if (!node) throw new Error(`The home's file has no object called ${thing.name}.`);
      return node;
    });
    this.joints = new JointRig(manifest.joints, (name) => this.named.get(name));
    const texture = softDisc();
    this.shadows = manifest.agents.map(() => this.addShadow(texture));
    this.rigs = manifest.agents.map((agent) => (agent.kind === "robot" ? this.robotRig(agent) : personRig(root, agent)));
  }

  /** What is seen of each agent. */
  get bodies(): Object3D[][] {
    return this.rigs.map((rig) => (rig instanceof RobotRig ? rig.nodes.filter((node) => node !== undefined) : rig.meshes));
  }

  /** Bones of people that were found by name, of all that states move. */
  get bonesFound(): number {
    return this.rigs.reduce((sum, rig) => sum + ("bones" in rig ? rig.bones.filter(Boolean).length : 0), 0);
  }

  /** Lowest point of a thing below its origin, m. */
  lowest(thing: Object3D): number {
    return new Box3().setFromObject(thing).min.y - thing.getWorldPosition(this.from).y;
  }

  /** Whether the home's ceilings are parts of their own. */
  get hasLids(): boolean {
    return this.lids.length > 0;
  }

  showLids(shown: boolean): void {
    for (const lid of this.lids) lid.visible = shown;
  }

  /** Without a head, who looks through the person's eyes sees the body and not the inside of the face. */
  showHead(agent: number, shown: boolean): void {
    const rig = this.rigs[agent];
    if (rig && "bones" in rig) rig.bones.find((bone) => bone && nameOf(bone) === "neck")?.scale.setScalar(shown ? 1 : 1e-3);
  }

  showBody(agent: number, shown: boolean): void {
    const rig = this.rigs[agent];
    if (rig && "meshes" in rig) for (const mesh of rig.meshes) mesh.visible = shown;
  }

  /** Shows or hides everything of an agent. */
  showAgent(agent: number, shown: boolean): void {
    this.shadows[agent]!.visible = shown;
    const rig = this.rigs[agent]!;
    for (const node of rig instanceof RobotRig ? rig.nodes : rig.meshes) if (node) node.visible = shown;
  }

  /** Poses everything between two states; what is absent (NaN) is hidden. `own` takes the place of the base of agent `me`, and what it holds rides along. */
  pose(a: State, b: State, share: number, me: number, own: Base | null): void {
    this.joints.pose(a.joints, b.joints, share);
    this.manifest.agents.forEach((agent, k) => {
      const was = a.agents[k]!;
      const is = b.agents[k]!;
      const rig = this.rigs[k]!;
      const base = between(was, is, share);
      const shown = k === me && own ? own : base;
      if (!Number.isFinite(base.x)) return this.showAgent(k, false);
      const { y, pitch } = this.floor.slope(shown.x, shown.z, shown.heading, agent.climbs ?? 0);
      const floor = is.y === undefined || was.y === undefined ? y : was.y + (is.y - was.y) * share;
      this.shadows[k]!.position.set(shown.x, floor + this.floor.riser(shown.x, shown.z) / 2 + 0.006, shown.z);
      if (rig instanceof RobotRig) {
        const joints = [(was as RobotState).joints, (is as RobotState).joints] as const;
        rig.pose(this.from.set(shown.x, floor, shown.z), shown.heading, pitch, ...joints, share);
      } else this.posePerson(rig, was as PersonState, is as PersonState, share, base, shown);
    });
    b.things.forEach((thing, k) => {
      const node = this.things[k]!;
      const was = a.things[k]!.pose;
      node.visible = Number.isFinite(was[0]) && Number.isFinite(thing.pose[0]);
      if (!node.visible) return;
      lerpPose(node, was, thing.pose, share, this.turn);
      if (own && thing.held === me && a.things[k]!.held === me) {
        this.carry(node, between(a.agents[me]!, b.agents[me]!, share), own);
      }
    });
  }

  private posePerson(rig: PersonRig, a: PersonState, b: PersonState, share: number, base: Base, shown: Base): void {
    const pelvis = rig.bones[0];
    if (!pelvis) return;
    lerpPose(pelvis, a.root, b.root, share, this.turn);
    if (shown !== base) this.carry(pelvis, base, shown);
    for (let k = 1; k < rig.bones.length && 4 * k <= a.quats.length; k++) {
      const i = 4 * (k - 1);
      this.turn.fromArray(b.quats, i);
      rig.bones[k]?.quaternion.fromArray(a.quats, i).slerp(this.turn, share);
    }
    for (const { half, joint, rest } of rig.halves) half.quaternion.copy(rest).slerp(joint.quaternion, 0.5);
  }

  /** Moves a node as if the base under it were somewhere else. */
  private carry(node: Object3D, from: Base, to: Base): void {
    const turn = to.heading - from.heading;
    node.position.sub(this.from.set(from.x, this.floor.height(from.x, from.z), from.z)).applyAxisAngle(UP, turn);
    node.position.add(this.from.set(to.x, this.floor.height(to.x, to.z), to.z));
    node.quaternion.premultiply(this.swing.setFromAxisAngle(UP, turn));
  }

  private sort(node: Object3D, fullName: string): void {
    const name = fullName.replace(/^upper_/, "");
    if (name.startsWith("ceiling")) this.lids.push(node);
    else if (this.manifest.agents.some((agent) => agent.name === fullName)) return;
    else this.home.push(node);
    if (name.startsWith("wall") || STAIRWELL.has(name)) this.solid.push(node);
    if (name.startsWith("floor_") || name.startsWith("rug") || name === "floor") this.floors.push(node);
    if (TALL.some((kind) => name.startsWith(kind))) this.solid.push(node);
  }

  private robotRig(agent: StagedAgent): RobotRig {
    const links = agent.links ?? [];
    const nodes = links.map((link) => this.named.get(`${agent.name}/${link.name}`));
    return new RobotRig(links, agent.base ?? [0, 0, 0, 0, 0, 0, 1], nodes);
  }

  private addShadow(map: CanvasTexture): Mesh {
    const material = new MeshBasicMaterial({ map, transparent: true, depthWrite: false, opacity: 0.55 });
    const shadow = new Mesh(new PlaneGeometry(2 * SHADOW_M, 2 * SHADOW_M), material);
    shadow.rotation.x = -Math.PI / 2;
    this.scene.add(shadow);
    return shadow;
  }
}

/** Between storeys: its walls, what is under the upper one, and the stairs, into which a camera behind who walks down would sink. */
const STAIRWELL = new Set(["stairwell", "cellar", "stairs"]);

/** Furniture that would stand between the camera and the person. */
const TALL = ["fridge", "wardrobe", "shelf", "front_door", "kitchen_cabinet", "shower", "window", "blind"];

function personRig(root: Group, agent: StagedAgent): PersonRig {
  const group = root.children.find((node) => nameOf(node) === agent.name && !("isMesh" in node) && node.children.length);
  const bones = new Map<string, Bone>();
  group?.traverse((node) => {
    if ("isBone" in node) bones.set(nameOf(node), node as Bone);
  });
  const meshes: Object3D[] = [];
  root.traverse((node) => {
    if ("isSkinnedMesh" in node && [nameOf(node), nameOf(node.parent!)].includes(agent.name)) meshes.push(node);
  });
  return { bones: (agent.bones ?? []).map((name) => bones.get(name)), meshes, halves: halfJoints(bones, meshes) };
}

/** Half joints of a skin by their names, with the rotation that their joints have at rest. */
function halfJoints(bones: Map<string, Bone>, meshes: Object3D[]): HalfJoint[] {
  const skeleton = (meshes[0] as SkinnedMesh | undefined)?.skeleton;
  const inverse = (bone: Object3D): Matrix4 => skeleton?.boneInverses[skeleton.bones.indexOf(bone as Bone)] ?? new Matrix4();
  return [...bones].flatMap(([name, half]) => {
    const joint = name.endsWith("_half") ? bones.get(name.slice(0, -5)) : undefined;
    if (!joint) return [];
    const local = inverse(joint.parent!).clone().multiply(inverse(joint).clone().invert());
    return [{ half, joint, rest: new Quaternion().setFromRotationMatrix(local) }];
  });
}

/** three cleans names (`robot/arm` loses its slash, doubles get a number): user data keep what the file said. */
const nameOf = (node: Object3D): string => (node.userData.name as string | undefined) ?? node.name;

export function between(a: Base, b: Base, share: number): Base {
  const mix = (u: number, v: number): number => u + (v - u) * share;
  // headings are told in -pi..pi: between two of them lies the shorter turn
  return { x: mix(a.x, b.x), z: mix(a.z, b.z), heading: a.heading + wrapAngle(b.heading - a.heading) * share };
}

function lerpPose(node: Object3D, a: Float32Array, b: Float32Array, share: number, turn: Quaternion): void {
  const mix = (k: number): number => a[k]! + (b[k]! - a[k]!) * share;
  node.position.set(mix(0), mix(1), mix(2));
  node.quaternion.fromArray(a, 3).slerp(turn.fromArray(b, 3), share);
}

/** Everything in a home is matt: the same picture at half the cost, which counts where a processor draws it. */
const matt = cached((material: MeshStandardMaterial): MeshLambertMaterial => {
  const { color, map, side, transparent, opacity, alphaTest, vertexColors, emissive } = material;
  return new MeshLambertMaterial({ color, map, side, transparent, opacity, alphaTest, vertexColors, emissive });
});

function cached<A extends object, B>(make: (key: A) => B): (key: A) => B {
  const made = new Map<A, B>();
  return (key) => {
    if (!made.has(key)) made.set(key, make(key));
    return made.get(key)!;
  };
}

function lights(): Object3D[] {
  const sun = new DirectionalLight(0xfff4e2, 1.4);
  sun.position.set(4, 9, 2.5);
  const fill = new DirectionalLight(0xdfe9ff, 0.5);
  fill.position.set(-5, 4, -4);
  return [new HemisphereLight(0xffffff, 0xdcd2c4, 2.1), sun, fill];
}

function softDisc(): CanvasTexture {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const brush = canvas.getContext("2d")!;
  const fade = brush.createRadialGradient(32, 32, 4, 32, 32, 32);
  fade.addColorStop(0, "rgba(0,0,0,0.75)");
  fade.addColorStop(0.6, "rgba(0,0,0,0.35)");
  fade.addColorStop(1, "rgba(0,0,0,0)");
  brush.fillStyle = fade;
  brush.fillRect(0, 0, 64, 64);
  return new CanvasTexture(canvas);
}
