"""Parts that all HTML pages and pictures share: style, palette, escaping, and charts as inline SVG."""
