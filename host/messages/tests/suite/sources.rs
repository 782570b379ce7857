//! Tests definitions of topics that carry none: from folders, bundled ones, and those of an
//! installed ROS 2.

use std::path::{Path, PathBuf};
use std::slice;
use std::sync::atomic::{AtomicUsize, Ordering};

use gleaner_drives::Replay;
use gleaner_messages::transport::Transport;
use gleaner_messages::{Definitions, FieldPath, Sources, SourcesError};

use gleaner_test_support::drives::sample_drive;

struct DefinitionsFolder(PathBuf);

impl DefinitionsFolder {
    fn new() -> Self {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let name =
            format!("definitions-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn write(&self, name: &str, text: impl AsRef<[u8]>) {
        let path = self.0.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    fn sources(&self) -> Sources {
        Sources::new(slice::from_ref(&self.0), &[])
    }
}

impl Drop for DefinitionsFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn in_folder(files: &[(&str, &str)]) -> (DefinitionsFolder, Sources) {
    let folder = DefinitionsFolder::new();
    for (name, text) in files {
        folder.write(name, text);
    }
    let sources = folder.sources();
    (folder, sources)
}

fn bundled() -> Sources {
    Sources::new(&[], &[])
}

/// Names of all bundled types, read from the file itself.
fn bundled_names() -> Vec<String> {
    let text = include_str!("../../src/bundled.msgs");
    text.lines().filter_map(|line| line.strip_prefix("MSG: ")).map(str::to_owned).collect()
}

#[test]
fn every_bundled_type_is_complete() {
    let names = bundled_names();
    assert!(names.len() > 130, "{}", names.len());
    for name in names {
        let text = bundled().find(&name).unwrap_or_else(|error| panic!("{name}: {error}"));
        Definitions::parse(&name, &text.unwrap()).unwrap();
    }
}

#[test]
fn the_types_of_sensors_and_vehicles_are_bundled() {
    for name in [
        "builtin_interfaces/msg/Time",
        "std_msgs/msg/Header",
        "std_msgs/Empty",
        "geometry_msgs/msg/TwistStamped",
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/PointCloud2",
        "sensor_msgs/msg/TimeReference",
        "nav_msgs/msg/Odometry",
        "diagnostic_msgs/msg/DiagnosticArray",
        "visualization_msgs/msg/MarkerArray",
        "tf2_msgs/msg/TFMessage",
        "rosgraph_msgs/msg/Clock",
        "rcl_interfaces/msg/Log",
    ] {
        assert!(bundled().find(name).unwrap().is_some(), "{name}");
    }
}

#[test]
fn the_text_is_that_of_recordings() {
    let replay = Replay::open(&[sample_drive()]).unwrap();
    let topics = replay.topics();
    assert!(topics.len() >= 3);
    for topic in topics {
        let found = bundled().find(&topic.type_name).unwrap().unwrap();
        let recorded = topic.definitions_text.unwrap();
        assert_eq!(found.trim_end(), recorded.trim_end(), "{}", topic.type_name);
    }
}

#[test]
fn a_type_is_found_in_each_of_the_three_places_in_a_folder() {
    for place in ["mine/msg/Speed.msg", "mine/Speed.msg", "Speed.msg"] {
        let (_folder, sources) = in_folder(&[(place, "std_msgs/Header header\nfloat32 kmh")]);
        let text = sources.find("mine/msg/Speed").unwrap().unwrap();
        let definitions = Definitions::parse("mine/msg/Speed", &text).unwrap();
        FieldPath::compile(&definitions, "header.stamp.sec").unwrap();
        FieldPath::compile(&definitions, "kmh").unwrap();
    }
}

#[test]
fn folders_precede_bundled_definitions_and_these_installed_ones() {
    let (folder, installed) = (DefinitionsFolder::new(), DefinitionsFolder::new());
    folder.write("std_msgs/msg/Bool.msg", "bool from_folder");
    for (name, text) in
        [("std_msgs/msg/Bool", "bool installed"), ("std_msgs/msg/Int8", "int8 installed")]
    {
        installed.write(&format!("share/{name}.msg"), text);
    }
    installed.write("share/maker/msg/Odd.msg", "Part part\n");
    installed.write("share/maker/msg/Part.msg", "int8 x\n");
    let sources = Sources::new(slice::from_ref(&folder.0), slice::from_ref(&installed.0));
    let text = |name| sources.find(name).unwrap().unwrap();
    assert_eq!(&*text("std_msgs/msg/Bool"), "bool from_folder\n");
    assert_eq!(&*text("std_msgs/msg/Int8"), "int8 data\n");
    let expected = format!("Part part\n{}\nMSG: maker/Part\nint8 x\n", "=".repeat(80));
    assert_eq!(*text("maker/msg/Odd"), expected);
}

#[test]
fn a_type_that_no_place_has_is_not_an_error() {
    assert_eq!(bundled().find("nobody_msgs/msg/Nothing").unwrap(), None);
    let gone = Sources::new(&[PathBuf::from("no/such/folder")], &[PathBuf::from("nor/this")]);
    assert_eq!(gone.find("nobody_msgs/msg/Nothing").unwrap(), None);
}

#[test]
fn a_name_that_could_be_a_path_is_refused() {
    let (_folder, sources) =
        in_folder(&[("up/msg/Secret.msg", "int8 x"), ("Secret.msg", "int8 x")]);
    let long = format!("up/{}", "x".repeat(200));
    for name in [
        "",
        "/",
        "../up/Secret",
        "up/../Secret",
        "up/msg/../Secret",
        "/etc/passwd",
        "up/srv/Secret",
        "up",
        &long,
    ] {
        assert!(matches!(sources.find(name), Err(SourcesError::Name { .. })), "{name}");
    }
    let error = sources.find("up/\u{1b}[2J").unwrap_err().to_string();
    assert!(!error.contains('\u{1b}'), "{error}");
}

#[test]
fn a_file_cannot_lead_out_of_the_folder() {
    let (_folder, sources) = in_folder(&[("p/msg/A.msg", "a/../../b/C c")]);
    assert!(matches!(sources.find("p/msg/A"), Err(SourcesError::Unusable { .. })));
    let (_folder, sources) = in_folder(&[("p/msg/A.msg", "a/b/c/D c")]);
    assert!(matches!(sources.find("p/msg/A"), Err(SourcesError::Missing { .. })));
}

#[test]
fn the_error_names_a_missing_type_and_its_referrer() {
    let (_folder, sources) = in_folder(&[("p/msg/A.msg", "B b"), ("p/msg/B.msg", "q/Gone[] x")]);
    let error = sources.find("p/msg/A").unwrap_err().to_string();
    assert_eq!(error, "`p/B` refers to `q/Gone`, whose definition cannot be found");
}

#[test]
fn cycles_and_excessive_depth_or_size_are_refused() {
    let (_folder, sources) = in_folder(&[("p/msg/A.msg", "B b"), ("p/msg/B.msg", "A[] a")]);
    assert!(matches!(sources.find("p/msg/A"), Err(SourcesError::Unusable { .. })));

    let chain = |length: usize| {
        let folder = DefinitionsFolder::new();
        for n in 0..length {
            folder.write(&format!("p/msg/T{n}.msg"), format!("T{} x", n + 1));
        }
        let sources = folder.sources();
        (folder, sources)
    };
    let (folder, sources) = chain(40);
    folder.write("p/msg/T40.msg", "int8 x");
    assert!(matches!(sources.find("p/msg/T0"), Err(SourcesError::Unusable { .. })));
    let (_folder, sources) = chain(300);
    assert!(matches!(sources.find("p/msg/T0"), Err(SourcesError::TooLarge { .. })));

    let folder = DefinitionsFolder::new();
    folder.write("p/msg/All.msg", (0..10).map(|n| format!("T{n} t{n}\n")).collect::<String>());
    for n in 0..10 {
        folder.write(&format!("p/msg/T{n}.msg"), "# some words\n".repeat(80_000) + "int8 x\n");
    }
    let sources = folder.sources();
    assert!(sources.find("p/msg/T1").unwrap().is_some());
    assert!(matches!(sources.find("p/msg/All"), Err(SourcesError::TooLarge { .. })));
}

#[test]
fn the_error_names_an_invalid_file() {
    let (folder, sources) =
        in_folder(&[("p/msg/Bad.msg", "int8\n"), ("p/msg/Two.msg", "int8 x\n===\nMSG: p/B\n")]);
    folder.write("p/msg/Big.msg", vec![b'\n'; (1 << 20) + 1]);
    folder.write("p/msg/Latin.msg", b"int8 x # \xe4\n");
    std::fs::create_dir_all(folder.0.join("p/msg/Folder.msg")).unwrap();
    assert!(matches!(sources.find("p/msg/Bad"), Err(SourcesError::Unusable { .. })));
    assert!(matches!(sources.find("p/msg/Two"), Err(SourcesError::Several { .. })));
    assert!(matches!(sources.find("p/msg/Big"), Err(SourcesError::NotText { .. })));
    assert!(matches!(sources.find("p/msg/Latin"), Err(SourcesError::NotText { .. })));
    assert_eq!(sources.find("p/msg/Folder").unwrap(), None);
}
