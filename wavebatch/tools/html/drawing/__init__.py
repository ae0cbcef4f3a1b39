"""Pictures inside a page, without matplotlib: charts as SVG, maps as PNG, and the figures made of them."""
