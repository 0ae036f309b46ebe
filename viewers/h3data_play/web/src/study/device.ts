/** What kind of computer and connection this is: classes, nothing that would tell one computer from another of its kind. */

export interface DeviceReport {
  webgl: boolean;
  ping_ms: number;
  fps: number;
  width: number;
  height: number;
  touch: boolean;
  headset: boolean;
  browser: string;
  system: string;
  gpu: string;
  /** Whether a window that is too small cannot be enlarged. */
  final?: boolean;
}

const PINGS = 9;
const FRAMES_MS = 1000;
const BROWSERS: [string, RegExp][] = [
  ["Quest", /OculusBrowser/],
  ["Edge", /Edg\//],
  ["Opera", /OPR\//],
  ["Firefox", /Firefox\//],
  ["Chromium", /Chrom(e|ium)\//],
  ["Safari", /Safari\//],
];
const SYSTEMS: [string, RegExp][] = [
  ["Android", /Android/],
  ["iOS", /iPhone|iPad/],
  ["Windows", /Windows/],
  ["macOS", /Mac OS X/],
  ["ChromeOS", /CrOS/],
  ["Linux", /Linux/],
];
const GPUS: [string, RegExp][] = [
  ["software", /SwiftShader|llvmpipe|Basic Render/i],
  ["NVIDIA", /NVIDIA|GeForce/i],
  ["AMD", /AMD|Radeon/i],
  ["Apple", /Apple/i],
  ["Intel", /Intel/i],
  ["Adreno", /Adreno/i],
  ["Mali", /Mali/i],
];

export async function deviceReport(): Promise<DeviceReport> {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2");
  const gpu = gl?.getExtension("WEBGL_debug_renderer_info");
  return {
    webgl: gl !== null,
    ping_ms: await ping(),
    fps: gl ? await frameRate(gl) : 0,
    width: innerWidth,
    height: innerHeight,
    touch: matchMedia("(pointer: coarse)").matches,
    headset: (await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false)) ?? false,
    browser: classOf(BROWSERS, navigator.userAgent),
    system: classOf(SYSTEMS, navigator.userAgent),
    gpu: gl ? classOf(GPUS, String(gl.getParameter(gpu ? gpu.UNMASKED_RENDERER_WEBGL : gl.RENDERER))) : "",
  };
}

/** Median round trip [ms]; the first one may still open the connection. */
async function ping(): Promise<number> {
  const trips: number[] = [];
  for (let k = 0; k < PINGS; k++) {
    const start = performance.now();
    await fetch("api/study/ping", { cache: "no-store" });
    if (k) trips.push(performance.now() - start);
  }
  trips.sort((a, b) => a - b);
  return Math.round(trips[trips.length >> 1]! * 10) / 10;
}

/** Blank pictures per second. */
function frameRate(gl: WebGL2RenderingContext): Promise<number> {
  return new Promise((resolve) => {
    let frames = 0;
    const start = performance.now();
    const frame = (): void => {
      gl.clearColor((frames % 10) / 10, 0.2, 0.3, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      frames++;
      const passed = performance.now() - start;
      if (passed < FRAMES_MS) requestAnimationFrame(frame);
      else resolve(Math.round((frames / passed) * 10_000) / 10);
    };
    requestAnimationFrame(frame);
  });
}

function classOf(classes: [string, RegExp][], text: string): string {
  return classes.find(([, pattern]) => pattern.test(text))?.[0] ?? "other";
}
