"""Sortable gallery of pictures: one HTML file beside them, which needs no network and no server."""

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from urllib.parse import quote

from asca_pillars.pictures.colors import class_rgb


@dataclass(frozen=True)
class GalleryCard:
    """One picture and its caption."""

    title: str
    picture: PurePath
    """Path relative to the page."""
    values: Mapping[str, float]
    """Counts and scores by name, by which the page sorts; a card that lacks one, or whose is NaN, comes last."""
    classes: Mapping[str, int] = field(default_factory=dict)
    """Number of boxes of each class."""
    remarks: Sequence[str] = ()


def gallery_page(
    title: str, introduction: str, cards: Sequence[GalleryCard], first: str | None, *, end: str = ""
) -> str:
    """Return the HTML of a page: a grid of pictures, each of which opens in full size.

    Args:
        title: of the page.
        introduction: plain text; empty lines divide paragraphs.
        cards: in the order of their files.
        first: the value that they are sorted by at first, the largest on top; None: as they come.
        end: text after the HTML, such as the sentence by which a command recognizes its page.
    """
    names = list(dict.fromkeys(name for card in cards for name in card.values))
    buttons = "".join(_button(name, pressed=name == first) for name in ["order", *names])
    paragraphs = "".join(f"<p>{_text(part)}</p>" for part in introduction.strip().split("\n\n") if part)
    figures = "".join(_figure(number, card) for number, card in enumerate(cards))
    count = f"{len(cards)} pictures" if len(cards) != 1 else "1 picture"
    body = figures or "<p>There is nothing to show.</p>"
    return (
        _PAGE.format(
            title=_text(title),
            style=_STYLE,
            introduction=paragraphs,
            count=count,
            buttons=buttons,
            figures=body,
            script=_SCRIPT.replace("FIRST", json.dumps(first or "order").replace("<", "\\u003c")),
        )
        + end
    )


def _button(name: str, *, pressed: bool) -> str:
    text, state = _text(name), str(pressed).lower()
    return f'<button type="button" data-key="{text}" aria-pressed="{state}">{text}</button>'


def _figure(number: int, card: GalleryCard) -> str:
    source = quote(card.picture.as_posix())
    values = {name: value for name, value in card.values.items() if value == value}
    pairs = "".join(f"<span><b>{_number(value)}</b> {_text(name)}</span>" for name, value in values.items())
    chips = "".join(_chip(name, count) for name, count in card.classes.items() if count)
    remarks = "".join(f"<p>{_text(line)}</p>" for line in card.remarks)
    return (
        f'<figure data-order="{number}" data-values="{_text(json.dumps(values))}">'
        f'<a href="{source}"><img src="{source}" loading="lazy" decoding="async" alt="{_text(card.title)}"></a>'
        f"<figcaption><h2>{_text(card.title)}</h2><div>{chips}</div><div>{pairs}</div>{remarks}</figcaption></figure>\n"
    )


def _chip(name: str, count: int) -> str:
    red, green, blue = class_rgb(name)
    return f'<span class="chip" style="--class: rgb({red} {green} {blue})">{_text(name)} {count}</span>'


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.2f}"


def _text(text: str) -> str:
    """Escape a text for HTML, as content or in an attribute."""
    return html.escape(text, quote=True)


_STYLE = """
:root { color-scheme: dark; }
* { box-sizing: border-box; }
body { margin: 0; padding: 24px; background: #0e1218; color: #d7e0e8; font: 15px/1.5 system-ui, sans-serif; }
header { max-width: 76ch; }
h1 { margin: 0 0 8px; font-size: 24px; }
h2 { margin: 0; font-size: 15px; overflow-wrap: anywhere; }
p { margin: 0 0 8px; color: #9aa8b5; }
nav { position: sticky; top: 0; z-index: 1; display: flex; flex-wrap: wrap; gap: 6px; align-items: center;
  margin: 16px -24px; padding: 10px 24px; background: #0e1218f2; border-bottom: 1px solid #2a343f; }
nav label { margin-left: auto; }
button, input { padding: 5px 10px; border: 1px solid #2f3b47; border-radius: 6px; background: none; color: inherit;
  font: inherit; }
button { cursor: pointer; }
button[aria-pressed=true] { border-color: #5ec8ff; color: #5ec8ff; }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(320px, 100%), 1fr)); gap: 18px; }
figure { margin: 0; overflow: hidden; border: 1px solid #2a343f; border-radius: 8px; background: #151b23; }
figure a { display: block; }
figure img { display: block; width: 100%; height: 300px; object-fit: cover; object-position: bottom; }
figcaption { padding: 10px 12px; }
figcaption span { margin-right: 12px; color: #9aa8b5; white-space: nowrap; }
figcaption b { color: #d7e0e8; font-variant-numeric: tabular-nums; }
figcaption p { margin: 6px 0 0; font-size: 13px; }
.chip::before { content: ""; display: inline-block; width: 9px; height: 9px; margin-right: 5px; border-radius: 2px;
  background: var(--class); }
dialog { width: 100vw; height: 100vh; max-width: none; max-height: none; padding: 0; border: 0; background: #0a0d11f5; }
dialog img { position: absolute; inset: 0 0 44px; width: 100%; height: calc(100% - 44px); object-fit: contain; }
dialog p { position: absolute; left: 0; right: 0; bottom: 8px; margin: 0; padding: 0 16px; text-align: center;
  color: #d7e0e8; }
@media (max-width: 600px) { body { padding: 14px; } nav { margin: 12px -14px; padding: 8px 14px; } }
"""

_SCRIPT = """
const main = document.querySelector("main");
const figures = [...main.querySelectorAll("figure")];
const value = (figure, key) => JSON.parse(figure.dataset.values)[key];
let key = FIRST, down = true;
function sort() {
  const order = (figure) => Number(figure.dataset.order);
  figures.sort((a, b) => {
    if (key === "order") return (order(a) - order(b)) * (down ? 1 : -1);
    const [x, y] = [value(a, key), value(b, key)];
    if (x === undefined || y === undefined) return (x === undefined) - (y === undefined) || order(a) - order(b);
    return (down ? y - x : x - y) || order(a) - order(b);
  });
  main.append(...figures);
  for (const button of document.querySelectorAll("nav button")) {
    const own = button.dataset.key === key;
    button.setAttribute("aria-pressed", own);
    const first = key === "order" ? down : !down;
    button.textContent = button.dataset.key + (own ? (first ? " \\u2191" : " \\u2193") : "");
  }
}
document.querySelector("nav").addEventListener("click", ({ target }) => {
  if (!target.dataset.key) return;
  down = target.dataset.key === key ? !down : true;
  key = target.dataset.key;
  sort();
});
document.querySelector("input").addEventListener("input", ({ target }) => {
  const wanted = target.value.toLowerCase();
  for (const figure of figures) figure.hidden = !figure.textContent.toLowerCase().includes(wanted);
});
const dialog = document.querySelector("dialog");
let at = 0;
function show(step) {
  const seen = figures.filter((figure) => !figure.hidden);
  at = (at + step + seen.length) % seen.length;
  dialog.querySelector("img").src = seen[at].querySelector("a").href;
  dialog.querySelector("p").textContent = `${seen[at].querySelector("h2").textContent} (${at + 1} of ${seen.length})`;
}
main.addEventListener("click", (event) => {
  const link = event.target.closest("a");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  at = figures.filter((figure) => !figure.hidden).indexOf(link.parentElement);
  show(0);
  dialog.showModal();
});
dialog.addEventListener("click", () => dialog.close());
dialog.addEventListener("keydown", ({ key: pressed }) => {
  if (pressed === "ArrowRight" || pressed === "ArrowDown") show(1);
  if (pressed === "ArrowLeft" || pressed === "ArrowUp") show(-1);
});
sort();
"""

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<header><h1>{title}</h1>{introduction}</header>
<nav><span>{count}, by</span>{buttons}<label>Show <input type="search" placeholder="name or class"></label></nav>
<main>
{figures}</main>
<dialog><img alt=""><p></p></dialog>
<script>{script}</script>
</body>
</html>
"""
