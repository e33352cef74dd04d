//! A secured farm as its people make it: `farmctl init`, `token`, `join`, the daemons with what these have written, and strangers.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    fs,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::Output,
};

use tests::{Process, farmctl};

/// A secured coordinator, and where its people keep their identities.
struct SecuredFarm {
    folder: tempfile::TempDir,
    coordinator: Process,
    grpc: String,
}

impl SecuredFarm {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let state = folder.path().join("state");
        let operator = folder.path().join("operator.pem");
        let made = farmctl(["init", text(&state), "--farm", "studio", "--identity", text(&operator)]);
        assert!(made.status.success(), "{made:?}");
        assert!(stdout(&made).contains("gleaner://studio/operator/operator"), "{made:?}");
        let flags = ["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", "--state", text(&state)];
        let mut coordinator = Process::start_on_small_disk("farm-coordinator", flags);
        let grpc = coordinator.next_json()["grpc"].as_str().unwrap().to_owned();
        Self { folder, coordinator, grpc }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(format!("{name}.pem"))
    }

    /// `farmctl` as somebody.
    fn as_who(&self, who: &str, arguments: &[&str]) -> Output {
        let identity = self.file(who);
        farmctl(["--coordinator", &self.grpc, "--identity", text(&identity)].iter().chain(arguments))
    }

    fn join(&self, role: &str, name: &str) {
        let token = stdout(&self.as_who("operator", &["token", "create", role]));
        let joined = self.as_who(name, &["join", token.trim(), "--name", name]);
        assert!(joined.status.success(), "{joined:?}");
        let mode = fs::metadata(self.file(name)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "the identity is its owner's alone");
    }

    /// Of somebody who joins a project.
    fn join_project(&self, name: &str, project: &str) {
        let token = stdout(&self.as_who("operator", &["token", "create", "app", "--project", project]));
        let joined = self.as_who(name, &["join", token.trim(), "--name", name]);
        assert!(joined.status.success(), "{joined:?}");
    }

    fn worker(&self, flags: &[&str]) -> Process {
        self.worker_on("sim", flags)
    }

    fn worker_on(&self, device: &str, flags: &[&str]) -> Process {
        let common = ["--coordinator", &self.grpc, "--device", device, "--connect-timeout", "5s"];
        Process::start("farm-worker", common.iter().chain(flags))
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[test]
fn members_work_and_strangers_are_told_how_to_become_members() {
    let farm = SecuredFarm::start();
    farm.join("node", "gpu-1");
    farm.join("app", "artist");
    let node = farm.file("gpu-1");
    let mut worker = farm.worker(&["--identity", text(&node)]);
    assert_eq!(worker.next_json()["event"], "ready");

    let status = farm.as_who("artist", &["-o", "json", "status"]);
    let status: serde_json::Value = serde_json::from_slice(&status.stdout).unwrap();
    assert_eq!(status["nodes"][0]["name"], "gpu-1", "the node has the name of its identity: {status}");

    let drained = farm.as_who("artist", &["node", "drain", "gpu-1"]);
    assert_eq!(drained.status.code(), Some(4), "an artist drains nothing: {drained:?}");
    assert!(stderr(&drained).contains("gleaner://studio/app/artist may not operate the farm"), "{drained:?}");
    let as_node = farm.as_who("gpu-1", &["status"]);
    assert_eq!(as_node.status.code(), Some(4), "{as_node:?}");

    // In plain text, whatever there is in this machine's home.
    let stranger = farmctl(["--insecure", "--coordinator", &farm.grpc, "status"]);
    assert_eq!(stranger.status.code(), Some(4), "{stranger:?}");
    assert!(stderr(&stranger).contains("farmctl join TOKEN"), "{stranger:?}");
    let (ended, words) = farm.worker(&["--insecure"]).finish();
    assert_eq!(ended.code(), Some(4), "{words}");
    let (ended, words) = farm.worker(&["--identity", text(&farm.file("artist"))]).finish();
    assert_eq!(ended.code(), Some(2), "{words}");
    assert!(words.contains("not of a node"), "{words}");

    let drained = farm.as_who("operator", &["node", "drain", "gpu-1"]);
    assert!(drained.status.success(), "{drained:?}");
    let (ended, words) = worker.finish();
    assert!(ended.success(), "{words}");
    let audit = fs::read_to_string(farm.folder.path().join("state/audit.ndjson")).unwrap();
    for event in ["token created", "joined", "refused", "drain"] {
        assert!(audit.contains(&format!("\"event\":\"{event}\"")), "no {event:?} in:\n{audit}");
    }
    let token = stdout(&farm.as_who("operator", &["token", "create", "app"]));
    assert!(!audit.contains(&token.trim()[13..45]), "no secret is in the log");
}

#[test]
fn a_token_is_listed_taken_back_and_used_once() {
    let farm = SecuredFarm::start();
    let made = farm
        .as_who("operator", &["-o", "json", "token", "create", "node", "--name", "gpu-7", "--expires", "5m"]);
    let made: serde_json::Value = serde_json::from_slice(&made.stdout).unwrap();
    let token = made["token"].as_str().unwrap();
    let listed = stdout(&farm.as_who("operator", &["token", "ls"]));
    assert!(listed.contains("gpu-7") && listed.contains("5 min"), "{listed}");
    assert!(!listed.contains(token), "the list holds no secrets:\n{listed}");
    let joined = farm.as_who("gpu-7", &["join", token]);
    assert!(joined.status.success(), "{joined:?}");
    let again = farm.as_who("gpu-7", &["join", token]);
    assert_eq!(again.status.code(), Some(4), "{again:?}");
    assert!(fs::exists(farm.file("gpu-7")).unwrap(), "a failed join takes nothing away");
    let slip = farm.as_who("x", &["join", &token[..40]]);
    assert_eq!(slip.status.code(), Some(2), "{slip:?}");
    assert!(!stderr(&slip).contains(&token[13..40]), "an error does not repeat a secret: {slip:?}");

    let second = farm.as_who("operator", &["-o", "json", "token", "create", "app"]);
    let second: serde_json::Value = serde_json::from_slice(&second.stdout).unwrap();
    let revoked = farm.as_who("operator", &["token", "revoke", &second["id"].to_string()]);
    assert!(revoked.status.success(), "{revoked:?}");
    let refused = farm.as_who("y", &["join", second["token"].as_str().unwrap(), "--name", "y"]);
    assert_eq!(refused.status.code(), Some(4), "{refused:?}");

    let members = stdout(&farm.as_who("operator", &["member", "ls"]));
    assert_eq!(members, "gleaner://studio/node/gpu-7\ngleaner://studio/operator/operator\n");
    let expelled = farm.as_who("operator", &["member", "expel", "gleaner://studio/node/gpu-7"]);
    assert!(expelled.status.success(), "{expelled:?}");
    let (ended, words) = farm.worker(&["--identity", text(&farm.file("gpu-7"))]).finish();
    assert_eq!(ended.code(), Some(4), "{words}");
}

#[test]
fn an_identity_that_is_there_is_kept_when_another_takes_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("user.pem");
    for farm in ["first", "second"] {
        let state = folder.path().join(farm);
        let made = farmctl(["init", text(&state), "--farm", farm, "--identity", text(&file)]);
        assert!(made.status.success(), "{made:?}");
    }
    let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
    assert!(
        read("user.pem").contains("gleaner://second/") && read("user.1.pem").contains("gleaner://first/")
    );
    let again = farmctl(["init", text(&folder.path().join("first")), "--identity", text(&file)]);
    assert_eq!(again.status.code(), Some(1), "{again:?}");
    assert!(read("user.pem").contains("gleaner://second/"), "what failed took nothing away");
    let broken = folder.path().join("broken.pem");
    fs::write(&broken, "nothing").unwrap();
    let refused = farmctl(["--identity", text(&broken), "status"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert!(stderr(&refused).contains("broken.pem"), "{refused:?}");
}

/// 6 of `tests/README.md`: what was acknowledged stays, who works goes on, and when there is room again all is well without a
/// restart. The limit is harder than a full disk: nothing that is there can be overwritten either.
#[test]
fn s06_a_full_disk_under_the_control_store_refuses_changes_and_nothing_else() {
    let farm = SecuredFarm::start();
    farm.join("node", "gpu-1");
    let mut worker = farm.worker(&["--identity", text(&farm.file("gpu-1"))]);
    assert_eq!(worker.next_json()["event"], "ready");
    farm.coordinator.fill_disk(true);
    for _ in 0..2 {
        let refused = farm.as_who("operator", &["token", "create", "app"]);
        assert_eq!(refused.status.code(), Some(1), "{refused:?}");
        assert!(stderr(&refused).contains("File too large"), "it says why: {refused:?}");
    }
    farm.coordinator.fill_disk(false);
    let tokens = stdout(&farm.as_who("operator", &["-o", "json", "token", "ls"]));
    assert_eq!(tokens.trim(), "[]", "the one that was used is gone, the others never were");
    farm.join("app", "artist");
    let members = stdout(&farm.as_who("operator", &["member", "ls"]));
    assert!(members.contains("node/gpu-1") && members.contains("app/artist"), "{members}");
    let status = farm.as_who("artist", &["-o", "json", "status"]);
    let status: serde_json::Value = serde_json::from_slice(&status.stdout).unwrap();
    assert_eq!(status["nodes"][0]["name"], "gpu-1", "it was there all the time: {status}");
    let (ended, words) = {
        worker.signal(tests::Signal::Term);
        worker.finish()
    };
    assert!(ended.success(), "{words}");
    assert!(!words.contains("the coordinator is lost"), "its session stood:\n{words}");
}

/// Issue 6, quotas by project, as an operator and an artist see them.
#[test]
fn a_project_has_what_its_quota_says() {
    let farm = SecuredFarm::start();
    let as_operator = |arguments: &[&str]| farm.as_who("operator", arguments);
    let _workers: Vec<Process> = ["gpu-1", "gpu-2"]
        .into_iter()
        .map(|name| {
            farm.join("node", name);
            let mut worker = farm.worker_on("cpu", &["--identity", text(&farm.file(name))]);
            assert_eq!(worker.next_json()["event"], "ready");
            worker
        })
        .collect();
    let set =
        as_operator(&["project", "set", "films", "--devices", "1", "--queued-jobs", "3", "--bytes", "1GiB"]);
    assert_eq!(stdout(&set), "films may have 1 device, 3 queued jobs, 1.0 GiB\n", "{set:?}");
    farm.join_project("artist", "films");
    let members = stdout(&as_operator(&["member", "ls"]));
    assert!(members.contains("gleaner://studio/app/artist  films\n"), "{members}");

    let path = |name: &str| farm.folder.path().join(name).display().to_string();
    let (scene, image) = (path("cornell"), path("image.exr"));
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success());
    let render = ["render", &scene, "-o", &image, "--size", "128x96", "--spp", "4"];
    let done = farm.as_who("artist", &render);
    assert!(done.status.success(), "{}", stderr(&done));
    let timeline = farm.as_who("artist", &["timeline", "-o", "json"]);
    let timeline: serde_json::Value = serde_json::from_slice(&timeline.stdout).unwrap();
    let segments = timeline["segments"].as_array().unwrap();
    let mut spans: Vec<(u64, u64, &str)> = segments
        .iter()
        .map(|segment| {
            let [from, to] = ["scheduled_at", "ended_at"].map(|field| segment[field].as_u64().unwrap());
            (from, to, segment["node"].as_str().unwrap())
        })
        .collect();
    spans.sort_unstable();
    assert!(spans.len() > 3, "{timeline}");
    for (scheduled_at, _, node) in &spans {
        let at_once = spans.iter().filter(|(from, to, _)| from <= scheduled_at && scheduled_at < to);
        let (mut jobs, mut elsewhere) = (0, 0);
        at_once.for_each(|(_, _, other)| {
            jobs += 1;
            elsewhere += u32::from(other != node);
        });
        assert!(
            jobs <= 3 && elsewhere == 0,
            "{jobs} jobs, {elsewhere} of them on another device: {timeline}"
        );
    }

    let set = as_operator(&["project", "set", "films", "--bytes", "1kB", "--devices", "none"]);
    assert_eq!(stdout(&set), "films may have 3 queued jobs, 1000 B\n", "{set:?}");
    let refused = farm.as_who("artist", &render);
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(stderr(&refused).contains("project films may have 1000 B"), "{}", stderr(&refused));
    let audit = fs::read_to_string(farm.folder.path().join("state/audit.ndjson")).unwrap();
    assert!(audit.contains("project films may have 1000 B"), "{audit}");

    let listed = stdout(&as_operator(&["project", "ls"]));
    assert!(listed.contains("default") && listed.contains("0 B of 1000 B"), "{listed}");
    let denied = farm.as_who("artist", &["project", "set", "films", "--bytes", "none"]);
    assert_eq!(denied.status.code(), Some(4), "{denied:?}");
    let removed = as_operator(&["project", "rm", "films"]);
    assert_eq!(removed.status.code(), Some(2), "somebody belongs to it: {removed:?}");
    assert!(as_operator(&["member", "expel", "gleaner://studio/app/artist"]).status.success());
    assert!(as_operator(&["project", "rm", "films"]).status.success());
    let slip = as_operator(&["token", "create", "app", "--project", "films"]);
    assert_eq!(slip.status.code(), Some(2), "{slip:?}");
    assert!(stderr(&slip).contains("farmctl project set films"), "{}", stderr(&slip));
}
