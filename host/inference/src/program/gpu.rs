//! Names what an engine of TensorRT depends on, on this machine: its libraries, the GPU and the
//! driver.

use std::fs::{self, File};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::library;

/// Prefixes of the names of the libraries: the provider of ONNX Runtime, and TensorRT itself.
const LIBRARIES: [&str; 2] = ["libonnxruntime_providers_tensorrt.so", "libnvinfer.so"];

/// Folder of the system with libraries of CUDA, beside those of [`library`].
const CUDA: &str = "/usr/local/cuda/lib64";

/// Files with the version of the driver, and the name of a board with a GPU.
const FILES: [&str; 4] = [
    "proc/driver/nvidia/version",
    "sys/module/nvidia/version",
    "etc/nv_tegra_release",
    "proc/device-tree/model",
];

/// Folder with a folder for each GPU that is no part of a board.
const GPUS: &str = "proc/driver/nvidia/gpus";

/// Bytes that are read of a file.
const READ_BYTES: u64 = 400;

/// Most files of one kind.
const FILES_MAX: usize = 8;

/// Returns one line about the machine below `root`, with ONNX Runtime in the file `library` and
/// further libraries in the folders that are `named`. It changes if a library, the GPU or the
/// driver is replaced. The files of the system can be read only before the sandbox closes.
pub(super) fn describe(root: &Path, library: &Path, named: &[PathBuf]) -> String {
    let real = library.canonicalize().ok();
    let beside = real.as_deref().and_then(Path::parent).map(Path::to_owned);
    let system = library::FOLDERS.into_iter().chain([CUDA]);
    let system = system.map(|folder| root.join(folder.trim_start_matches('/')));
    let folders: Vec<PathBuf> = beside.into_iter().chain(named.to_vec()).chain(system).collect();
    let mut parts = Vec::new();
    for prefix in LIBRARIES {
        let mut found: Vec<String> = folders.iter().flat_map(|it| libraries(it, prefix)).collect();
        found.sort();
        found.dedup();
        found.truncate(FILES_MAX);
        parts.push(if found.is_empty() { format!("no {prefix}") } else { found.join(", ") });
    }
    let gpus = entries(&root.join(GPUS)).into_iter().map(|gpu| gpu.join("information"));
    let known = FILES.iter().map(|file| root.join(file)).chain(gpus.take(FILES_MAX));
    let known: Vec<String> = known.filter_map(|file| line_of(&file)).collect();
    parts.push(if known.is_empty() { "no NVIDIA driver".to_owned() } else { known.join(", ") });
    parts.join("; ")
}

/// Returns the libraries in a folder whose name begins with `prefix`, each with the length and the
/// time of its file.
fn libraries(folder: &Path, prefix: &str) -> Vec<String> {
    let found = entries(folder).into_iter().filter_map(|path| {
        let name = path.file_name()?.to_str()?;
        let (real, meta) = (path.canonicalize().ok()?, fs::metadata(&path).ok()?);
        let real = name.starts_with(prefix).then_some(real)?;
        let name = real.file_name()?.to_string_lossy().into_owned();
        Some(format!("{} of {} bytes at {}", clean(&name), meta.len(), meta.mtime()))
    });
    found.collect()
}

/// Returns the paths in a folder, in order; none if it does not exist.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// Returns the first line of a file.
fn line_of(file: &Path) -> Option<String> {
    let mut start = Vec::new();
    File::open(file).ok()?.take(READ_BYTES).read_to_end(&mut start).ok()?;
    let line = String::from_utf8_lossy(start.split(|byte| *byte == b'\n').next()?).into_owned();
    Some(clean(&line)).filter(|line| !line.is_empty())
}

fn clean(text: &str) -> String {
    let words: String = text.chars().map(|it| if it.is_control() { ' ' } else { it }).collect();
    words.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: &Path, text: &str) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn another_library_gpu_or_driver_gives_another_line() {
        let folder = tempfile::tempdir().unwrap();
        let (root, library) = (folder.path(), folder.path().join("ort/libonnxruntime.so.1.23.2"));
        let line = || describe(root, &library, &[]);
        assert_eq!(
            line(),
            "no libonnxruntime_providers_tensorrt.so; no libnvinfer.so; no NVIDIA driver"
        );
        let mut before = vec![line()];
        for (file, text) in [
            ("ort/libonnxruntime.so.1.23.2", "library"),
            ("ort/libonnxruntime_providers_tensorrt.so", "provider"),
            ("usr/lib/aarch64-linux-gnu/libnvinfer.so.10.3.0", "10.3"),
            ("usr/lib/aarch64-linux-gnu/libnvinfer.so.10.3.0", "10.3 again"),
            ("proc/driver/nvidia/version", "NVRM version: 540.4.0\tRelease\nGCC 11"),
            ("proc/device-tree/model", "NVIDIA Jetson Orin\0"),
            ("proc/driver/nvidia/gpus/0000:01:00.0/information", "Model: \t NVIDIA A2\nIRQ: 7\n"),
        ] {
            write(&root.join(file), text);
            let line = line();
            assert!(file.contains("libonnxruntime.so") || !before.contains(&line), "{line}");
            assert!(line.len() < 4000 && !line.contains(char::is_control), "{line}");
            before.push(line);
        }
        let line = before.last().unwrap();
        assert!(line.contains("libnvinfer.so.10.3.0 of 10 bytes at "), "{line}");
        let end = "; NVRM version: 540.4.0 Release, NVIDIA Jetson Orin, Model: NVIDIA A2";
        assert!(line.ends_with(end), "{line}");
    }
}
