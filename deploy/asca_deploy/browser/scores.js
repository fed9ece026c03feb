/**
 * Scores from which on boxes are shown, a slider for each class.
 *
 * Suppression goes from the best box to the worst, so that boxes below a score never remove those above it: what a
 * detector with a low threshold finds, filtered, is what it finds with a higher one.
 */

import { merge } from "./around.js";

export const LOWEST_SCORE = 0.1; // that the sliders reach
const HIGHEST_SCORE = 0.95;

export class ScoreSliders {
  /**
   * @param {HTMLElement} place that the sliders are put into
   * @param {{name: string, score: number, lowest: number}[]} classes `score`: where a slider begins
   * @param {number} limit of the number of boxes
   * @param {() => void} changed called when a slider was moved
   */
  constructor(place, classes, limit, changed) {
    this.limit = limit;
    this.scores = Object.fromEntries(classes.map(({ name, score }) => [name, score]));
    place.append(...classes.map((class_) => this.slider(class_, changed)));
    place.hidden = classes.every(({ score, lowest }) => lowest >= Math.max(score, HIGHEST_SCORE));
  }

  /**
   * The places of the boxes to show among detections, best first.
   * @param {object[]} detections
   * @param {{passes: number, iou: number}} [merging] of passes whose boxes are not merged yet: a box removes others there
   *   by its direction, not by its score, so that those below the scores have to be gone
   */
  chosen(detections, merging) {
    const places = detections.flatMap(({ class: name, score }, place) => (score >= this.scores[name] ? [place] : []));
    if (!merging) return places.slice(0, this.limit);
    const left = new Array(merging.passes).fill(this.limit);
    const found = places.filter((place) => left[detections[place].pass]-- > 0);
    const candidates = found.map((place) => ({ ...detections[place], label: detections[place].class, place }));
    return merge(candidates, merging).map(({ place }) => place);
  }

  slider({ name, score, lowest }, changed) {
    const label = Object.assign(document.createElement("label"), { textContent: name });
    const shown = Object.assign(document.createElement("output"), { textContent: score.toFixed(2) });
    const range = document.createElement("input");
    const max = Math.max(score, HIGHEST_SCORE);
    Object.assign(range, { type: "range", min: lowest, max, step: "any", name, value: score });
    range.addEventListener("input", () => {
      this.scores[name] = range.valueAsNumber;
      shown.textContent = range.valueAsNumber.toFixed(2);
      changed();
    });
    label.append(range, shown);
    return label;
  }
}
