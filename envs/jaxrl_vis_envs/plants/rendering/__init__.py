"""Rendering of plots: surfaces, rays through tiles of an image, light, and sensor.

surfaces    the plot as cones and triangles             tables     surfaces visible to a camera, by tile
drawing     rays to radiance, in JAX                    shading    radiance of the surfaces that rays hit
texture     noise on surfaces                           backdrop   distant background
blades      blades of grass                             panels     walls, fences and furniture in the world
walls       pictures of these                           overlays   lens flare, borders, lines drawn over an image
imaging     radiance to pixel values                    degrading  effects of simple cameras on images
"""
