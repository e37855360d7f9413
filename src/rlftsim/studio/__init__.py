"""Goal studio: a page on this machine that asks agents for things and shows what happens.

`serving.Studio` starts a server and stops it; `server.create_app` has the routes, `guard.Guard` stands before all of
them, `session.Session` holds data and models, `runs.Worker` simulates in one thread. The page is in `static/`, plain
ES modules; they share `viewer/drawing.js` with the pages that stand alone. Needs the extra: `pip install
'rlftsim[studio]'`.
"""
