"""Pictures of waveforms and clouds, for `wavebatch plot`.

First the data as arrays (`waveform`; `sections`; values and maps of clouds: `tools/cells`), then the
drawing (`draw_waveform`, `draw_cloud`), so that everything but the drawing works and is tested without matplotlib.
"""
