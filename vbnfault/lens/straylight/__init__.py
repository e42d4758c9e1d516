"""Compute straylight on the sensor: ghosts, starburst, glare and veil of the Sun, and of a whole scene.

Modules:

- `settings` describes the Sun, the sensor, the state of the lens, and the path of the direct image.
- `bundles` traces bundles of rays along reflection paths, and `steps` advances the rays by one surface. These two
  modules clip rays at rims.
- `ghosts` computes the box of the rays that pass the lens, for each ghost, and the spectra of ghosts.
- `raster` draws bundles of rays on the sensor, and `pyramid` adds up the levels on which they are drawn.
- `irradiance` renders the image of all ghosts with these modules, and lists them (flux, position and size).
- `starburst` computes the light that the stop diffracts.
- `scatter` computes the glare, which surfaces and dust scatter, and the transmission of a baffle; `particles`
  computes how dust scatters.
- `total` adds the veil, and returns the sum of all straylight and the remaining fraction of the direct image.
- `scene` computes ghosts, glare and veil of everything that a render shows, with `ghost_response` (ghosts of every
  field angle, traced once for a lens) and `scene_convolution` (glare and diffraction).

To change where ghosts are clipped, see `steps`, which lists all code that does so.
"""
