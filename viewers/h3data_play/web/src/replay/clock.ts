/** Where the replay is, and whether it runs. */

import type { Episode } from "./episode.ts";

export class Clock {
  playing = false;
  speed = 1;
  private readonly listeners: (() => void)[] = [];
  private at = 0;

  constructor(private readonly episode: Episode) {}

  get seconds(): number {
    return this.at;
  }

  get row(): number {
    return this.episode.at(this.at).row;
  }

  get atEnd(): boolean {
    return this.at >= this.episode.seconds;
  }

  onChange(listener: () => void): void {
    this.listeners.push(listener);
  }

  play(on: boolean): void {
    if (on && this.atEnd) this.at = 0;
    this.playing = on;
    this.tell();
  }

  /** Advances by the time of a frame. */
  tick(seconds: number): void {
    if (!this.playing) return;
    this.at = Math.min(this.at + seconds * this.speed, this.episode.seconds);
    if (this.atEnd) this.playing = false;
    this.tell();
  }

  seek(seconds: number): void {
    this.at = Math.min(Math.max(seconds, 0), this.episode.seconds);
    this.tell();
  }

  toRow(row: number): void {
    this.seek(this.episode.times[Math.min(Math.max(row, 0), this.episode.rows - 1)]!);
  }

  /** A step forwards or back; the replay stands then. */
  step(by: number): void {
    this.playing = false;
    const { row, share } = this.episode.at(this.at);
    this.toRow(by < 0 && share > 0.01 ? row + by + 1 : row + by);
  }

  setSpeed(speed: number): void {
    this.speed = speed;
    this.tell();
  }

  private tell(): void {
    for (const listener of this.listeners) listener();
  }
}
