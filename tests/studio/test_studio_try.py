def test_it(client, session):
    print(client.get("/").status_code, client.get("/api/session").json())
    rows = client.get("/api/scenarios", params={"split": "validation", "query": "n_ped>0"}).json()
    print(rows["total"], rows["rows"][0])
    i = "9d639de83d6f5239"
    s = client.get(f"/api/scenario/validation/{i}"); print(s.status_code, len(s.content))
    agents=[a[0] for a in s.json()["scene"]["agents"]]
    ego=[a[0] for a in s.json()["scene"]["agents"] if a[4]==2][0]
    p = client.get(f"/api/proposals/validation/{i}/{ego}"); print(str(p.json())[:300])
    import time; t=time.time()
    st = client.finished(split="validation", scenario=i, models=["demo-base","goals"], num_rollouts=8, goals=[{"agent":ego,"x":p.json()["proposals"][0]["x"],"y":p.json()["proposals"][0]["y"]}])
    print(time.time()-t, st["variants"]); 
    for e in st["events"]:
        if e["event"]!="progress": print(e["event"], str(e["data"])[:700])
    print(len(client.get(f"/api/runs/{st['run']}/chunk/0").content))
    print(client.get(f"/api/runs/{st['run']}/explain?variant=1").text[:200])
    for kind in ("rollouts","submission","scores","page","film-webp"):
        t=time.time(); r=client.post("/api/export", {"kind":kind,"name":"x","run":st["run"],"variant":1}); print(kind, r.status_code, r.text, time.time()-t)
