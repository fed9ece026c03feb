/** Where boxes come from: a worker of this page, or `asca view`, which detects on this computer. */

/** The detector of worker.js. */
export class WorkerDetector {
  constructor() {
    this.asked = 0;
    this.waiting = new Map(); // by the number of the task
    this.worker = new Worker("worker.js", { type: "module" });
    this.worker.addEventListener("message", ({ data }) => this.answered(data));
    this.worker.addEventListener("error", (event) => {
      for (const { reject } of this.waiting.values()) reject(new Error(event.message || "worker.js cannot be loaded"));
      this.waiting.clear();
    });
  }

  /** The manifest of the bundle. */
  open() {
    return this.ask("open", {});
  }

  /**
   * The boxes of one file.
   * @param {{name: string, buffer: ArrayBuffer}} file
   * @param {{axes: string, height: string, around: boolean|undefined}} sensor as `asca detect` takes it; empty: as in training
   * @param {(points: Float32Array) => void} preview called with the points, before the boxes are there
   */
  detect(file, sensor, preview) {
    return this.ask("detect", { ...file, sensor }, preview);
  }

  ask(task, given, preview) {
    const id = this.asked++;
    this.worker.postMessage({ id, task, ...given });
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject, preview }));
  }

  answered({ id, result, error, preview: points }) {
    const { resolve, reject, preview } = this.waiting.get(id);
    if (points !== undefined) {
      preview(points);
      return;
    }
    this.waiting.delete(id);
    if (error === undefined) resolve(result);
    else reject(new Error(error));
  }
}

/** The detector of `asca view`: asked for the points of a scan, then for its boxes. */
export class ServedDetector {
  async detect({ number }, sensor, preview) {
    const points = new Float32Array(await (await fetched(`scans/${number}.bin`)).arrayBuffer());
    preview(points);
    return { points, ...(await (await fetched(`scans/${number}.json`)).json()) };
  }
}

/** A file of the server; what it says where a scan cannot be read. */
export async function fetched(file) {
  const response = await fetch(file);
  if (response.status === 422) throw new Error(await response.text());
  if (!response.ok) throw new Error(`${file}: ${response.status} ${response.statusText}`);
  return response;
}
