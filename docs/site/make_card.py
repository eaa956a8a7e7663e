"""Writes docs/site/static/card.png, the picture of link previews, from the README's pictures (extra `plot`)."""

from pathlib import Path

import matplotlib.pyplot as plt
from PIL import GifImagePlugin, Image

HERE = Path(__file__).parent
PICTURES = {"push": 12, "pick_and_place": 30, "block": 20}  # frames
TEXT = "Hindsight Experience Replay for robot arms, hands\nand your own MuJoCo robots, in JAX"


def main() -> None:
    """Draws three frames under the name: 1200 x 630 pixels, as the large previews are."""
    figure = plt.figure(figsize=(12, 6.3), dpi=100, facecolor="white")
    figure.text(0.05, 0.84, "mjx-dher", fontsize=54, weight="bold")
    figure.text(0.05, 0.68, TEXT, fontsize=25, color="#333333", linespacing=1.4)
    for i, (name, frame) in enumerate(PICTURES.items()):
        axis = figure.add_axes((0.05 + 0.31 * i, 0.06, 0.28, 0.54))
        with GifImagePlugin.GifImageFile(HERE.parents[1] / "docs" / "images" / f"{name}.gif") as picture:
            picture.seek(min(frame, picture.n_frames - 1))
            axis.imshow(picture.convert("RGB"), aspect="equal")
        axis.set_axis_off()
    figure.savefig(HERE / "static" / "card.png")
    with Image.open(HERE / "static" / "card.png") as card:
        card.convert("P", palette=Image.Palette.ADAPTIVE, colors=128).save(HERE / "static" / "card.png", optimize=True)


if __name__ == "__main__":
    main()
