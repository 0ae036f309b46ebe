/** Doors and drawers of the home: forward kinematics of what their joints move. */

import { Matrix4, Vector3, type Object3D } from "three";

/** A joint as the home's file has it, all of it in the world (`h3data.replay.rigs`). */
export interface Joint {
  name: string;
  /** Index of the joint that carries it, which comes first; -1: the home. */
  parent: number;
  /** 1 turning, 2 sliding. */
  kind: number;
  axis: [number, number, number];
  origin: [number, number, number];
  /** Position in the file, when closed and when open, rad or m. */
  rest: number;
  closed: number;
  opened: number;
  /** Where a hand takes hold, in the file. */
  handle: [number, number, number];
  /** Names of what it moves: all but things that have poses of their own. */
  nodes: string[];
}

/** Hands get in from this share of its range on. */
const AJAR = 0.6;

/** Whether hands get in with a joint at a position. */
export function isOpen(joint: Joint, position: number): boolean {
  return (position - joint.closed) / (joint.opened - joint.closed) >= AJAR;
}

export class JointRig {
  /** Where hands take hold now. */
  readonly handles: Vector3[];
  private readonly axes: Vector3[];
  private readonly origins: Vector3[];
  /** From the file to where the joints have moved things. */
  private readonly motions: Matrix4[];
  private readonly moved: { node: Object3D; rest: Matrix4 }[][];
  private readonly owner = new Map<Object3D, number>();
  private readonly shown: Float32Array;
  private readonly matrix = new Matrix4();
  private readonly shift = new Vector3();

  constructor(
    readonly joints: Joint[],
    find: (name: string) => Object3D | undefined,
  ) {
    this.axes = joints.map((joint) => new Vector3(...joint.axis));
    this.origins = joints.map((joint) => new Vector3(...joint.origin));
    this.handles = joints.map((joint) => new Vector3(...joint.handle));
    this.motions = joints.map(() => new Matrix4());
    this.shown = Float32Array.from(joints, (joint) => joint.rest);
    this.moved = joints.map((joint, k) =>
      joint.nodes.flatMap((name) => {
        const node = find(name);
        if (!node) return [];
        node.updateMatrix();
        this.owner.set(node, k);
        return [{ node, rest: node.matrix.clone() }];
      }),
    );
  }

  /** The joint that moves a node, or what it is part of; -1: none. */
  of(node: Object3D): number {
    for (let at: Object3D | null = node; at; at = at.parent) {
      const joint = this.owner.get(at);
      if (joint !== undefined) return joint;
    }
    return -1;
  }

  /** Places what joints move for positions between two states. */
  pose(from: Float32Array, to: Float32Array, share: number): void {
    const turned = new Set<number>();
    this.joints.forEach((joint, k) => {
      const position = Math.fround(from[k]! + (to[k]! - from[k]!) * share);
      if (position === this.shown[k] && !turned.has(joint.parent)) return;
      this.shown[k] = position;
      turned.add(k);
      this.move(k, position);
    });
  }

  private move(k: number, position: number): void {
    const joint = this.joints[k]!;
    const motion = this.motions[k]!.identity();
    const by = position - joint.rest;
    if (joint.kind === 2) motion.setPosition(this.shift.copy(this.axes[k]!).multiplyScalar(by));
    else {
      // about an axis through a point: R p + (origin - R origin)
      const origin = this.origins[k]!;
      motion.makeRotationAxis(this.axes[k]!, by);
      this.shift.copy(origin).applyMatrix4(motion);
      motion.setPosition(origin.x - this.shift.x, origin.y - this.shift.y, origin.z - this.shift.z);
    }
    if (joint.parent >= 0) motion.premultiply(this.motions[joint.parent]!);
    this.handles[k]!.set(...joint.handle).applyMatrix4(motion);
    for (const { node, rest } of this.moved[k]!)
      this.matrix.multiplyMatrices(motion, rest).decompose(node.position, node.quaternion, node.scale);
  }
}
