"""`twin view`: a page in the browser that shows a built scene and drives the Husky in it.

A *picture* is the field rendered from a page's camera, with robot and obstacles in it: the background over which the
browser draws *layers* (geometry of the scene). It is *coarse* while something on the page moves, *fine* at rest. A *key
view* is a camera pose with a lighting; a *camera path* leads smoothly through key views and can be rendered to a film.
"""
