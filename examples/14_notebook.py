"""A notebook: editors run each part between the `# %%` lines as a cell; `jupytext` converts the
file to .ipynb.
"""

# %% [markdown]
# # A photo as a scene

# %%
from PIL import Image

import spackle
from spackle.core.color import to_uint8

scene = spackle.predict("photo.jpg")
print(scene)

# %% The viewer, in the notebook
scene.show(height=480)

# %% One view, as a picture
view = scene.render(scene.path("swipe", frames=3)[0])
Image.fromarray(to_uint8(view.rgb).numpy())

# %% A file to send
scene.export("photo.html")
