"""`twin view`: a page in the browser that shows a built scene and drives the Husky in it.

A *picture* shows the radiance field, robot and obstacles as a page's camera sees them. It is *coarse* while something
on the page moves, *fine* at rest. The browser draws *layers* (geometry of the scene) over it. A *key view* is a camera
pose with a lighting; a *camera path* leads smoothly through key views and can be rendered to a film.
"""
