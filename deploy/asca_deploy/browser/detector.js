/** A bundle in ONNX Runtime: points in, boxes out. Knows no page, so that node runs it too. */

import { decodeCandidates, suppress } from "./boxes.js";
import { makeGrid } from "./grid.js";
import { Canvas, pillarize } from "./pillars.js";

// It would quantize layers that an 8-bit bundle keeps in floating point (docs/BUNDLE.md).
const OPTIONS = { extra: { optimization: { disable_specified_optimizers: "WeightBiasQuantization" } } };

export class Detector {
  /**
   * @param {object} manifest bundle.json
   * @param {{encoder: Uint8Array, backbone: Uint8Array}} graphs the ONNX files
   * @param {object} ort onnxruntime-web, set to one thread: the encoder needs that (docs/BUNDLE.md)
   */
  static async open(manifest, graphs, ort) {
    if (manifest.schema_version !== 3 || manifest.kind !== "pillar") {
      throw new Error(`this page runs bundles of schema 3 and kind pillar, not ${manifest.schema_version} and ${manifest.kind}`);
    }
    if ((manifest.pillar.neck ?? "dense") !== "dense") throw new Error("this page runs bundles with a dense neck");
    if ((manifest.spec.anchor_places ?? "cells") !== "cells" || (manifest.spec.anchor_scores ?? "own") !== "own") {
      throw new Error("this page runs bundles with anchors at cell centers and one score for each");
    }
    const detector = new Detector();
    detector.ort = ort;
    detector.manifest = manifest;
    detector.grid = makeGrid(manifest.spec.grid);
    detector.encoder = await ort.InferenceSession.create(graphs.encoder, OPTIONS);
    detector.backbone = await ort.InferenceSession.create(graphs.backbone, OPTIONS);
    detector.canvas = new Canvas(detector.grid, manifest.pillar.channels, manifest.pillar.canvas);
    return detector;
  }

  /**
   * The boxes of one scan, best first, in the scan's frame.
   * @param {Float32Array} points x, y, z in metres (LiDAR frame), reflectance 0..1 of each of N points
   * @returns {Promise<{detections: object[], timesMs: object, counts: object}>}
   */
  async detect(points) {
    const { spec, pillar } = this.manifest;
    const timesMs = {};
    const timed = async (stage, work) => {
      const start = performance.now();
      const result = await work();
      timesMs[stage] = performance.now() - start;
      return result;
    };
    const pillars = await timed("pillarize", () => pillarize(points, this.grid, spec.limits));
    const features = await timed("encode", () => this.encode(pillars));
    await timed("scatter", () => this.canvas.scatter(features, pillars.cells));
    const maps = await timed("neck+head", () => this.neckAndHead());
    const found = await timed("decode", () =>
      suppress(decodeCandidates(maps, this.grid, spec, pillar.layout.anchor_yaws_rad), spec.post),
    );
    const detections = found.map(({ box, score, label }) => ({ class: spec.classes[label].name, score, box }));
    const counts = { points: points.length / 4, points_outside: pillars.outside, pillars: pillars.cells.length };
    return { detections, timesMs, counts };
  }

  /** Features of the pillars (P x C), of the canvas's type. */
  async encode({ features, pillarIndex, pointCounts }) {
    if (pointCounts.length === 0) return new this.canvas.values.constructor(0);
    const given = {
      features: new this.ort.Tensor("float32", features, [pillarIndex.length, 9]),
      pillar_index: new this.ort.Tensor("int64", pillarIndex, [pillarIndex.length]),
      point_counts: new this.ort.Tensor("int64", pointCounts, [pointCounts.length]),
    };
    const inputs = Object.fromEntries(this.encoder.inputNames.map((name) => [name, given[name]]));
    return (await this.encoder.run(inputs)).pillar_features.data;
  }

  /** Head maps of the canvas as it is, channels last. */
  async neckAndHead() {
    const type = this.manifest.pillar.canvas.type;
    const canvas = new this.ort.Tensor(type, this.canvas.values, this.canvas.shape);
    const { scores, boxes, directions } = await this.backbone.run({ canvas });
    return { scores: scores.data, boxes: boxes.data, directions: directions.data };
  }
}
