/** Short tones for those who want them: off until switched on. */

export type Cue = "take" | "put" | "done" | "refused" | "touch";

/** Frequencies [Hz] that follow each other, and how long each lasts [s]. */
const CUES: Record<Cue, { notes: number[]; each: number; kind: OscillatorType }> = {
  take: { notes: [523, 784], each: 0.07, kind: "sine" },
  put: { notes: [784, 523], each: 0.07, kind: "sine" },
  done: { notes: [523, 659, 784, 1047], each: 0.12, kind: "sine" },
  refused: { notes: [196], each: 0.16, kind: "triangle" },
  touch: { notes: [147, 131], each: 0.09, kind: "triangle" },
};

export class Sound {
  on = false;
  private context: AudioContext | undefined;

  /** Returns whether sound is on now; the browser needs a press of the player's before it plays anything. */
  toggle(): boolean {
    this.on = !this.on;
    this.context ??= new AudioContext();
    void (this.on ? this.context.resume() : this.context.suspend());
    return this.on;
  }

  play(cue: Cue): void {
    if (!this.on || !this.context) return;
    const { notes, each, kind } = CUES[cue];
    const start = this.context.currentTime;
    notes.forEach((note, k) => {
      const tone = this.context!.createOscillator();
      const loud = this.context!.createGain();
      const at = start + k * each;
      tone.type = kind;
      tone.frequency.value = note;
      loud.gain.setValueAtTime(0.0001, at);
      loud.gain.exponentialRampToValueAtTime(0.12, at + 0.01);
      loud.gain.exponentialRampToValueAtTime(0.0001, at + each);
      tone.connect(loud).connect(this.context!.destination);
      tone.start(at);
      tone.stop(at + each);
    });
  }
}
