"""Pictures of waveforms and clouds, for `wavebatch plot`.

First the data as arrays (`packets` and `waveform`; `values`, `histogram` and `raster`), then the drawing
(`draw_waveform`, `draw_cloud`), so that everything but the drawing works and is tested without matplotlib.
"""
