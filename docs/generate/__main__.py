"""Write the reference pages, and say which have changed."""

from __future__ import annotations

from docs.generate import PAGES, REFERENCE


def main() -> None:
    """`make docs`."""
    REFERENCE.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        path, text = REFERENCE / name, page()
        before = path.read_text(encoding="utf-8") if path.exists() else None
        path.write_text(text, encoding="utf-8")
        print(f"{path.relative_to(REFERENCE.parents[1])}: {'as before' if text == before else 'written'}")


if __name__ == "__main__":
    main()
