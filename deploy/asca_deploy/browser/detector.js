/** A bundle in ONNX Runtime: points in, boxes out. Knows no page, so that node runs it too. */

import { decodeCandidates, suppress } from "./boxes.js";
import { makeGrid, unseenDirections } from "./grid.js";
import { Canvas, pillarize } from "./pillars.js";
import { NeckTableBuilder } from "./tables.js";

// It would quantize layers that an 8-bit bundle keeps in floating point (docs/BUNDLE.md).
const OPTIONS = { extra: { optimization: { disable_specified_optimizers: "WeightBiasQuantization" } } };
const NOTHING = { scores: new Float32Array(0), boxes: new Float32Array(0), directions: new Float32Array(0) };

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
    if ((manifest.spec.anchor_places ?? "cells") !== "cells" || (manifest.spec.anchor_scores ?? "own") !== "own") {
      throw new Error("this page runs bundles with anchors at cell centers and one score for each");
    }
    const detector = new Detector();
    detector.ort = ort;
    detector.manifest = manifest;
    detector.grid = makeGrid(manifest.spec.grid);
    detector.encoder = await ort.InferenceSession.create(graphs.encoder, OPTIONS);
    detector.backbone = await ort.InferenceSession.create(graphs.backbone, OPTIONS);
    const { neck, channels, canvas, active_cells: rule } = manifest.pillar;
    if (neck === "sparse") detector.tables = new NeckTableBuilder(detector.grid.ny, detector.grid.nx, rule);
    else detector.canvas = new Canvas(detector.grid, channels, canvas);
    return detector;
  }

  /**
   * The boxes of one scan, best first, in the scan's frame.
   * @param {Float32Array} points x, y, z in metres (LiDAR frame), reflectance 0..1 of each of N points
   * @returns {Promise<{detections: object[], timesMs: object, counts: object, remarks: string[]}>}
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
    const placed = await timed(this.tables ? "tables" : "scatter", () => this.place(features, pillars.cells));
    const maps = await timed("neck+head", () => this.neckAndHead(placed));
    const found = await timed("decode", () => {
      const yaws = pillar.layout.anchor_yaws_rad;
      return suppress(decodeCandidates(maps, this.grid, spec, yaws, placed.headCells), spec.post);
    });
    const detections = found.map(({ box, score, label }) => ({ class: spec.classes[label].name, score, box }));
    const counts = { points: points.length / 4, points_outside: pillars.outside, pillars: pillars.cells.length };
    return { detections, timesMs, counts, remarks: unseenDirections(this.grid, points) };
  }

  /** Features of the pillars (P x C), of the canvas's type. */
  async encode({ features, pillarIndex, pointCounts }) {
    if (pointCounts.length === 0) return [];
    const given = {
      features: this.tensor("float32", features, [pillarIndex.length, 9]),
      pillar_index: this.tensor("int64", pillarIndex, [pillarIndex.length]),
      point_counts: this.tensor("int64", pointCounts, [pointCounts.length]),
    };
    return (await run(this.encoder, given)).pillar_features.data;
  }

  /** What backbone.onnx takes, and of a sparse neck the head cells that it answers for. */
  place(features, cells) {
    const { channels, canvas } = this.manifest.pillar;
    if (!this.tables) {
      this.canvas.scatter(features, cells);
      return { given: { canvas: this.tensor(canvas.type, this.canvas.values, this.canvas.shape) } };
    }
    const { inputs, headCells } = this.tables.build(cells);
    if (headCells.length === 0) return { headCells };
    const given = { pillar_features: this.tensor(canvas.type, features, [cells.length, channels]) };
    for (const [name, table] of Object.entries(inputs)) {
      const shape = name.startsWith("places") ? [table.length] : [table.length / 9, 9];
      given[name] = this.tensor("int32", table, shape);
    }
    return { given, headCells };
  }

  /** Head maps, channels last, or rows of the active head cells. */
  async neckAndHead({ given, headCells }) {
    if (headCells?.length === 0) return NOTHING;
    const { scores, boxes, directions } = await run(this.backbone, given);
    return { scores: scores.data, boxes: boxes.data, directions: directions.data };
  }

  tensor(type, values, shape) {
    return new this.ort.Tensor(type, values, shape);
  }
}

/** Run a graph on those of the tensors that it declares. */
function run(session, given) {
  return session.run(Object.fromEntries(session.inputNames.map((name) => [name, given[name]])));
}
