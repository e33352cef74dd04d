//! Plug-in policies as they run: the example, and plug-ins that are broken in every way we could think of.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on panics")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use coordinator::{
    CoordinatorOptions,
    plugins::{PluginOptions, Plugins},
};
use farm_core::{
    coordinator::policy::{Choice, Question, QuestionDevice, QuestionId, QuestionJob},
    id::{AppId, DeviceIndex, JobIndex, NodeId, TaskId},
};

const HOST: &str = env!("CARGO_BIN_EXE_farm-coordinator");
/// No answer of a test takes this long, on any machine.
const PATIENT: Duration = Duration::from_secs(300);

/// A plug-in whose `place` does this.
fn placing(body: &str) -> String {
    format!(
        "#include \"gleaner_policy_v1.h\"\n#include <stdio.h>\n#include <stdlib.h>\n\
         static int32_t place(const gleaner_batch_v1 *batch, gleaner_choice_v1 *choices) {{\n\
         (void)batch; (void)choices;\n{body}\n}}\n\
         const struct gleaner_policy_v1 gleaner_policy_v1 = {{ 1, sizeof(struct gleaner_policy_v1), \"test\", place }};\n"
    )
}

/// All jobs to the first device, in order; `unless` comes before.
fn first_device(unless: &str) -> String {
    placing(&format!(
        "{unless}\nfor (uint32_t i = 0; i < batch->job_count; i++) {{ choices[i].job = i; choices[i].device = 0; }}\n\
         return 0;"
    ))
}

/// A folder of plug-ins.
struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn with(name: &str, source: &str) -> Self {
        let folder = Self::new();
        folder.build(name, source);
        folder
    }

    fn build(&self, name: &str, source: &str) -> PathBuf {
        let object = self.0.path().join(format!("{name}.so"));
        let file = self.0.path().join(format!("{name}.c"));
        fs::write(&file, source).unwrap();
        let include = Path::new(env!("CARGO_MANIFEST_DIR")).join("include");
        let output = Command::new("cc")
            .args(["-fPIC", "-shared", "-O0", "-I"])
            .arg(include)
            .arg("-o")
            .args([&object, &file])
            .output()
            .unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
        object
    }

    fn options(&self) -> PluginOptions {
        PluginOptions {
            answer_limit: PATIENT,
            restart_delay: Duration::ZERO,
            ..PluginOptions::new(self.0.path(), HOST)
        }
    }

    async fn open(&self) -> Plugins {
        Plugins::open(&self.options()).await.unwrap()
    }
}

/// Jobs of load 10 each; devices of these speeds.
fn question(jobs: u32, speeds: &[f64]) -> Question {
    let devices = speeds.iter().zip(1..).map(|(speed, node)| QuestionDevice {
        node: NodeId(node),
        device: DeviceIndex(0),
        free_at_ns: 0.0,
        time_per_load: 1.0 / speed,
        ready_at_ns: 0.0,
    });
    Question {
        app: AppId(1),
        task: TaskId(2),
        jobs: (0..jobs)
            .map(|index| QuestionJob { index: JobIndex(index), load: 10.0, avoid: None })
            .collect(),
        devices: devices.collect(),
    }
}

async fn ask(
    plugins: &mut Plugins,
    plugin: &str,
    id: u64,
    question: Question,
) -> Result<Vec<Choice>, String> {
    plugins.ask(QuestionId(id), plugin, question)?;
    let answered = plugins.answered().await;
    assert_eq!(answered.question, QuestionId(id), "one question, one answer");
    answered.answer
}

fn devices(answer: &[Choice]) -> Vec<u32> {
    answer.iter().map(|choice| choice.device).collect()
}

#[tokio::test]
async fn the_example_spreads_jobs_by_speed() {
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("plugin-example");
    let folder = Folder::new();
    // By its own Makefile, into a copy of its folder.
    let copy = folder.0.path().join("build/plugin-example");
    fs::create_dir_all(&copy).unwrap();
    for file in ["Makefile", "spread.c"] {
        fs::copy(example.join(file), copy.join(file)).unwrap();
    }
    std::os::unix::fs::symlink(example.with_file_name("include"), copy.with_file_name("include")).unwrap();
    let made = Command::new("make").arg("-C").arg(&copy).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    fs::copy(copy.join("spread.so"), folder.0.path().join("spread.so")).unwrap();

    let mut plugins = folder.open().await;
    assert_eq!(plugins.names().into_iter().collect::<Vec<_>>(), ["spread"]);
    let answer = ask(&mut plugins, "spread", 1, question(6, &[1.0, 0.5])).await.unwrap();
    assert_eq!(answer.iter().map(|choice| choice.job).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    assert_eq!(devices(&answer), [0, 1, 0, 0, 1, 0], "two to one, evenly");
    let answer = ask(&mut plugins, "spread", 2, question(4_096, &[1.0; 1_024])).await.unwrap();
    let mut shares = [0; 1_024];
    devices(&answer).iter().for_each(|&device| shares[device as usize] += 1);
    assert_eq!(shares, [4; 1_024], "a large batch over equal devices");
    let unknown = ask(&mut plugins, "../spread", 3, question(1, &[1.0])).await.unwrap_err();
    assert!(unknown.contains("no plug-in"), "{unknown}");
}

#[tokio::test]
async fn a_wrong_answer_is_none_and_the_next_one_counts() {
    // Asked for two jobs they do wrong, for three they do right.
    let cases = [
        ("choices[0].job = 0; choices[0].device = 7; return 0;", "device 7 of 2"),
        ("choices[0].job = 9; choices[0].device = 0; return 0;", "job 9 of 2"),
        ("choices[0].job = 0; choices[0].device = 0; return 0;", "choice 1 empty"),
        (
            "for (int i = 0; i < 2; i++) { choices[i].job = 1; choices[i].device = 0; } return 0;",
            "job 1, which has a place",
        ),
        ("for (int i = 0; i < 3; i++) choices[i].job = 0; return 0;", "more than the 2 choices"),
        ("return -3;", "returned -3"),
        ("raise(9);", "signal 9"),
        ("*(volatile int *)0 = 1;", "signal 11"),
        ("abort();", "signal 6"),
        ("exit(0);", "exit code 0"),
    ];
    for (wrong, says) in cases {
        let source = format!(
            "#include <signal.h>\n{}",
            first_device(&format!("if (batch->job_count == 2) {{ {wrong} }}"))
        );
        let folder = Folder::with("wrong", &source);
        let mut plugins = folder.open().await;
        for round in [0, 2] {
            let error = ask(&mut plugins, "wrong", round, question(2, &[1.0, 1.0])).await.unwrap_err();
            assert!(error.contains(says), "{wrong}: {error}");
            // An overrun ends its process only after the answer: the next question may find that out.
            let mut right = ask(&mut plugins, "wrong", round + 1, question(3, &[1.0, 1.0])).await;
            if wrong.contains("i < 3") && right.is_err() {
                right = ask(&mut plugins, "wrong", round + 1, question(3, &[1.0, 1.0])).await;
            }
            assert_eq!(devices(&right.unwrap()), [0, 0, 0], "{wrong}");
        }
    }
}

#[tokio::test]
async fn a_slow_plugin_is_killed_and_rests() {
    let folder = Folder::with("slow", &placing("for (;;) {}"));
    let options =
        PluginOptions { answer_limit: Duration::from_millis(20), restart_delay: PATIENT, ..folder.options() };
    let mut plugins = Plugins::open(&options).await.unwrap();
    let error = ask(&mut plugins, "slow", 1, question(1, &[1.0])).await.unwrap_err();
    assert!(error.contains("did not answer within 20ms"), "{error}");
    let error = ask(&mut plugins, "slow", 2, question(1, &[1.0])).await.unwrap_err();
    assert!(error.contains("starts again in"), "{error}");
}

#[tokio::test]
async fn questions_that_wait_are_bounded() {
    let folder = Folder::with("slow", &placing("for (;;) {}"));
    let plugins = folder.open().await;
    // One may be with the plug-in already.
    let refused = (0..18).filter_map(|id| plugins.ask(QuestionId(id), "slow", question(1, &[1.0])).err());
    let refused: Vec<String> = refused.collect();
    assert!((1..=2).contains(&refused.len()) && refused[0].contains("16 questions"), "{refused:?}");
}

#[tokio::test]
async fn what_a_plugin_prints_is_no_answer() {
    let folder = Folder::with(
        "loud",
        &first_device("puts(\"{}\"); fflush(stdout); for (int i = 0; i < 9999; i++) fputs(\"x\", stderr);"),
    );
    let mut plugins = folder.open().await;
    for id in 0..3 {
        assert_eq!(devices(&ask(&mut plugins, "loud", id, question(2, &[1.0])).await.unwrap()), [0, 0]);
    }
}

#[tokio::test]
async fn the_host_dies_with_the_coordinator() {
    let folder = Folder::new();
    let lock = folder.0.path().join("lock");
    let source = first_device("").replace(
        "static int32_t",
        &format!(
            "#include <fcntl.h>\n#include <sys/file.h>\n\
             __attribute__((constructor)) static void hold(void) {{ flock(open({lock:?}, O_CREAT | O_RDWR, 0600), LOCK_EX); }}\n\
             static int32_t"
        ),
    );
    folder.build("held", &source);
    let mut plugins = folder.open().await;
    ask(&mut plugins, "held", 1, question(1, &[1.0])).await.unwrap();
    let file = fs::File::open(&lock).unwrap();
    assert!(file.try_lock().is_err(), "the process of the plug-in holds it");
    drop(plugins);
    // Returns when the process is gone.
    tokio::task::spawn_blocking(move || file.lock()).await.unwrap().unwrap();
}

#[tokio::test]
async fn what_is_no_plugin_is_refused_at_the_start() {
    let of = |fields: &str| {
        placing("return 0;").replace("{ 1, sizeof(struct gleaner_policy_v1), \"test\", place }", fields)
    };
    let cases = [
        (of("{ 2, sizeof(struct gleaner_policy_v1), \"test\", place }"), "speaks ABI 2"),
        (of("{ 1, 32, \"test\", place }"), "32 bytes"),
        (of("{ 1, sizeof(struct gleaner_policy_v1), \"test\", 0 }"), "place is NULL"),
        (of("{ 1, sizeof(struct gleaner_policy_v1), 0, place }"), "about is NULL"),
        ("int other;".to_owned(), "exports no gleaner_policy_v1"),
        ("int missing(void); int other(void) { return missing(); }".to_owned(), "cannot be loaded"),
        (
            "__attribute__((constructor)) static void f(void) { __builtin_trap(); }".to_owned(),
            "crashed with signal",
        ),
    ];
    let refused = async |folder: &Folder, says: &str| {
        let options =
            CoordinatorOptions { plugins: Some(folder.options()), ..CoordinatorOptions::embedded() };
        let error = coordinator::start(options).await.unwrap_err().to_string();
        assert!(error.contains("broken.so") && error.contains(says), "{says:?} is missing in: {error}");
    };
    for (source, says) in cases {
        refused(&Folder::with("broken", &source), says).await;
    }
    let folder = Folder::new();
    fs::write(folder.0.path().join("broken.so"), "no ELF at all").unwrap();
    refused(&folder, "cannot be loaded").await;

    let good = Folder::with("good", &first_device(""));
    let options = PluginOptions { host: good.0.path().join("nothing"), ..good.options() };
    let error = Plugins::open(&options).await.unwrap_err().to_string();
    assert!(error.contains("nothing") && error.contains("is not there"), "{error}");
    good.open().await;
}
