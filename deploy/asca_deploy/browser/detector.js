/** A bundle in ONNX Runtime: points in, boxes out. Knows no page, so that node runs it too. */

import { aboutGround, turnsAround, widenRanges, withoutOwnVehicle } from "./around.js";
import { decodeCandidates, suppress } from "./boxes.js";
import { changeBox, changePoints, inverse, turnBy } from "./frames.js";
import { makeGrid, percentBehind } from "./grid.js";
import { Canvas, pillarize } from "./pillars.js";
import { NeckRulebookBuilder } from "./rulebooks.js";

// It would quantize layers that an 8-bit bundle keeps in floating point (docs/BUNDLE.md).
const OPTIONS = { extra: { optimization: { disable_specified_optimizers: "WeightBiasQuantization" } } };
const NOTHING = { scores: new Float32Array(0), boxes: new Float32Array(0), directions: new Float32Array(0) };

export class Detector {
  /**
   * @param {object} manifest bundle.json
   * @param {Record<string, Uint8Array>} graphs the ONNX files by the names in `manifest.graphs`
   * @param {object} ort onnxruntime-web, set to one thread: the PFN layer needs that (docs/BUNDLE.md)
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
    detector.fields = new Map(); // by the spec
    for (const [name, graph] of Object.entries(graphs)) {
      detector[name] = await ort.InferenceSession.create(graph, OPTIONS); // pfn (older bundles have none), encoder, backbone
    }
    return detector;
  }

  /** Where the model looks, and what it keeps from scan to scan: `spec`, `grid`, and `rulebooks` or `canvas` of its neck. */
  field(around) {
    const spec = around ? widenRanges(this.manifest) : this.manifest.spec;
    const name = JSON.stringify(spec.grid);
    if (!this.fields.has(name)) {
      const { neck, channels, canvas, active_cells: rule } = this.manifest.pillar;
      const grid = makeGrid(spec.grid);
      const sparse = neck === "sparse";
      const rulebooks = sparse ? new NeckRulebookBuilder(grid.ny, grid.nx, rule) : undefined;
      this.fields.set(name, { spec, grid, rulebooks, canvas: sparse ? undefined : new Canvas(grid, channels, canvas) });
    }
    return this.fields.get(name);
  }

  /**
   * The boxes of one scan, pass by pass and the best first, in the scan's frame.
   * @param {Float32Array} points x, y, z in metres (the model's frame), reflectance 0..1 of each of N points
   * @param {boolean|undefined} around look in every direction, undefined: where points lie behind the sensor; the boxes of
   *   several passes are to be merged (`around.js`)
   * @returns {Promise<{detections: object[], passes: number, timesMs: object, counts: object, remarks: string[]}>}
   */
  async detect(points, around) {
    const behind = around ? 0 : percentBehind(this.field(false).grid, points);
    const everywhere = around ?? behind > 0;
    const field = this.field(everywhere);
    const turns = everywhere ? turnsAround(field.spec.grid, this.manifest.expected_input.camera_view) : [turnBy(0)];
    const [timesMs, detections] = [{}, []];
    const counts = { points: 0, points_outside: 0, pillars: 0 };
    const remarks = [];
    if (behind > 0 && around === undefined) remarks.push(`${behind}% of the points lie behind the sensor: looked at all around.`);
    if (behind > 0 && !everywhere) {
      remarks.push(`${behind}% of the points lie behind the sensor, where the model does not look: look all around.`);
    }
    const level = turns.length === 1 ? turns : aboutGround(turns, points);
    for (const [pass, turn] of level.entries()) {
      const back = inverse(turn);
      const seen = await this.pass(changePoints(turn, points), field, timesMs, counts);
      for (const { box, ...found } of everywhere ? withoutOwnVehicle(seen) : seen) {
        detections.push({ ...found, box: changeBox(back, box), pass, offAhead: Math.abs(Math.atan2(box[1], box[0])) });
      }
    }
    return { detections, passes: turns.length, timesMs, counts, remarks };
  }

  /** The boxes of one pass; adds to the times of the stages and to the counts. */
  async pass(points, field, timesMs, counts) {
    const { spec, grid } = field;
    const timed = async (stage, work) => {
      const start = performance.now();
      const result = await work();
      timesMs[stage] = (timesMs[stage] ?? 0) + performance.now() - start;
      return result;
    };
    const pillars = await timed("pillarize", () => pillarize(points, grid, spec.limits));
    const features = await timed("encode", () => this.encode(pillars));
    const placed = await timed(field.rulebooks ? "rulebooks" : "scatter", () => this.place(field, features, pillars.cells));
    const maps = await timed("neck+head", () => this.neckAndHead(placed));
    const found = await timed("decode", () => {
      const yaws = this.manifest.pillar.layout.anchor_yaws_rad;
      return suppress(decodeCandidates(maps, grid, spec, yaws, placed.headCells), spec.post);
    });
    counts.points += points.length / 4;
    counts.points_outside += pillars.outside;
    counts.pillars += pillars.cells.length;
    return found.map(({ box, score, label }) => ({ class: spec.classes[label].name, score, box }));
  }

  /** Features of the pillars (P x C), of the canvas's type. */
  async encode({ features, pillarIndex, pointCounts }) {
    if (pointCounts.length === 0) return [];
    const given = {
      features: this.tensor("float32", features, [pillarIndex.length, 9]),
      pillar_index: this.tensor("int64", pillarIndex, [pillarIndex.length]),
      point_counts: this.tensor("int64", pointCounts, [pointCounts.length]),
    };
    if (this.pfn) given.pillar_maxima = (await run(this.pfn, given, ["pillar_maxima"])).pillar_maxima;
    return (await run(this.encoder, given)).pillar_features.data;
  }

  /** What backbone.onnx takes, and of a sparse neck the head cells that it answers for. */
  place(field, features, cells) {
    const { channels, canvas } = this.manifest.pillar;
    if (!field.rulebooks) {
      field.canvas.scatter(features, cells);
      return { given: { canvas: this.tensor(canvas.type, field.canvas.values, field.canvas.shape) } };
    }
    const { inputs, headCells } = field.rulebooks.build(cells);
    if (headCells.length === 0) return { headCells };
    const given = { pillar_features: this.tensor(canvas.type, features, [cells.length, channels]) };
    for (const [name, rulebook] of Object.entries(inputs)) {
      const shape = name.startsWith("places") ? [rulebook.length] : [rulebook.length / 9, 9];
      given[name] = this.tensor("int32", rulebook, shape);
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

/** Run a graph on those of the tensors that it declares, for these outputs. */
function run(session, given, outputs = session.outputNames) {
  return session.run(Object.fromEntries(session.inputNames.map((name) => [name, given[name]])), outputs);
}
