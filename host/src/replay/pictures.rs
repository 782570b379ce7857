//! Makes small pictures of a camera's image at each trigger, for the report.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_base::safe_file;
use gleaner_lambda::signals::{Signals, TriggerPicture};
use gleaner_lambda::{Decision, Trigger};
use gleaner_messages::transport::SampleMeta;
use gleaner_recorder::{ObjectBox, is_image, thumbnail_with_boxes};

use crate::api::data::Topic;
use crate::session_setup::OutputError;

/// Folder of the pictures, below that of the results.
const FOLDER: &str = "pictures";

/// Prefix of the file names, which distinguishes these pictures from others.
const PREFIX: &str = "trigger-";

/// The newest image of a recorded topic that is no input of the lambda.
pub(super) struct RecordedCamera {
    topic: String,
    type_name: String,
    newest: Mutex<Option<(SampleMeta, Vec<u8>)>>,
}

impl RecordedCamera {
    pub(super) fn new(topic: &str, type_name: &str) -> Arc<Self> {
        Arc::new(Self {
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            newest: Mutex::default(),
        })
    }

    pub(super) fn see(&self, meta: &SampleMeta, cdr: &[u8]) {
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let mut bytes = newest.take().map(|(_, bytes)| bytes).unwrap_or_default();
        bytes.clear();
        bytes.extend_from_slice(cdr);
        *newest = Some((*meta, bytes));
    }
}

/// Pictures at the triggers of one pass over a drive. When there are too many, every second one is
/// dropped, so that the rest are spread over the whole drive.
pub(super) struct TriggerPictures {
    inputs: Vec<Arc<Topic>>,
    camera: Option<Arc<RecordedCamera>>,
    /// Number of wakes with a trigger.
    wakes: u64,
    /// One of so many such wakes has a picture.
    every: u64,
    pictures: Vec<PendingPicture>,
}

struct PendingPicture {
    wake: u64,
    at_ns: i64,
    topic: String,
    image_ns: i64,
    has_boxes: bool,
    jpeg: Vec<u8>,
}

impl TriggerPictures {
    /// Pictures of the first of `inputs` that has images, or else of `camera`.
    pub(super) fn new(inputs: &[Arc<Topic>], camera: Option<Arc<RecordedCamera>>) -> Self {
        let inputs = inputs.iter().filter(|topic| is_image(topic.type_name())).cloned().collect();
        Self { inputs, camera, wakes: 0, every: 1, pictures: Vec::new() }
    }

    /// Number of wakes with a trigger so far.
    pub(super) fn wakes(&self) -> u64 {
        self.wakes
    }

    /// Makes a picture if `decision` has a trigger; call it after each wake.
    pub(super) fn wake(&mut self, decision: &Decision) {
        if decision.triggers.is_empty() {
            return;
        }
        let wake = self.wakes;
        self.wakes += 1;
        if self.pictures.len() >= Signals::PICTURES_MAX {
            self.every *= 2;
            self.pictures.retain(|picture| picture.wake.is_multiple_of(self.every));
        }
        if wake.is_multiple_of(self.every)
            && let Some(picture) = self.make(wake, decision)
        {
            self.pictures.push(picture);
        }
    }

    fn make(&self, wake: u64, decision: &Decision) -> Option<PendingPicture> {
        let boxes: Vec<_> = decision.triggers.iter().filter_map(object_box).collect();
        let picture = |topic: &str, image_ns, jpeg| PendingPicture {
            wake,
            at_ns: decision.at_ns,
            topic: topic.to_owned(),
            image_ns,
            has_boxes: !boxes.is_empty(),
            jpeg,
        };
        let thumbnail = |type_name: &str, cdr: &[u8], meta: SampleMeta| {
            let as_before = self.as_before(meta.at_ns).filter(|_| boxes.is_empty());
            as_before.or_else(|| thumbnail_with_boxes(type_name, cdr, meta.endian, &boxes))
        };
        for topic in &self.inputs {
            // Not by the lambda's own calls: the journal notes how far the lambda looked back.
            let Some(lease) = topic.reader().newest() else { continue };
            let meta = lease.meta().sample;
            let jpeg = thumbnail(topic.type_name(), &lease, meta);
            return jpeg.map(|jpeg| picture(topic.ros_topic(), meta.at_ns, jpeg));
        }
        let camera = self.camera.as_ref()?;
        let newest = camera.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let (meta, cdr) = newest.as_ref()?;
        let jpeg = thumbnail(&camera.type_name, cdr, *meta);
        jpeg.map(|jpeg| picture(&camera.topic, meta.at_ns, jpeg))
    }

    /// The previous picture, if it is of the same image.
    fn as_before(&self, image_ns: i64) -> Option<Vec<u8>> {
        self.pictures
            .last()
            .filter(|picture| picture.image_ns == image_ns && !picture.has_boxes)
            .map(|picture| picture.jpeg.clone())
    }

    /// Writes the pictures below `out` and removes those of an earlier replay; also returns the
    /// number of wakes with a trigger that have no picture.
    pub(super) fn write(self, out: &Path) -> Result<(Vec<TriggerPicture>, u64), OutputError> {
        let folder = out.join(FOLDER);
        remove(&folder)?;
        let omitted = self.wakes - self.pictures.len() as u64;
        if self.pictures.is_empty() {
            return Ok((Vec::new(), omitted));
        }
        safe_file::folder(&folder).map_err(|source| OutputError { path: folder, source })?;
        let written = self.pictures.into_iter().map(
            |PendingPicture { at_ns, topic, image_ns, jpeg, wake, .. }| {
                let file = Path::new(FOLDER).join(format!("{PREFIX}{wake:06}.jpg"));
                let path = out.join(&file);
                // Always a new file: an existing one may be a link to another place.
                let written = File::create_new(&path).and_then(|mut file| file.write_all(&jpeg));
                written.map_err(|source| OutputError { path, source })?;
                Ok(TriggerPicture { at_ns, topic, image_ns, file })
            },
        );
        Ok((written.collect::<Result<_, _>>()?, omitted))
    }
}

/// Returns the box of a trigger with the attributes `x`, `y`, `width` and `height`, in pixels.
fn object_box(trigger: &Trigger) -> Option<ObjectBox> {
    let number = |name: &str| trigger.attributes.get(name)?.as_f64();
    let [x, y] = [number("x")?, number("y")?];
    let [width, height] = [number("width")?, number("height")?];
    (width > 0.0 && height > 0.0).then_some(ObjectBox { x, y, width, height })
}

/// Deletes the pictures of an earlier replay, and no other file in the folder.
fn remove(folder: &Path) -> Result<(), OutputError> {
    let failed = |source| OutputError { path: folder.to_owned(), source };
    // A link may lead to a user's pictures.
    if folder.symlink_metadata().is_ok() {
        safe_file::folder(folder).map_err(failed)?;
    }
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(failed)?,
    };
    for entry in entries {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let number = name
            .to_str()
            .and_then(|name| name.strip_prefix(PREFIX))
            .and_then(|name| name.strip_suffix(".jpg"));
        let number = number.unwrap_or_default();
        if !number.is_empty() && number.bytes().all(|digit| digit.is_ascii_digit()) {
            fs::remove_file(entry.path())
                .map_err(|source| OutputError { path: entry.path(), source })?;
        }
    }
    // The folder stays if it holds other files.
    let _ = fs::remove_dir(folder);
    Ok(())
}

#[cfg(test)]
mod tests {
    use gleaner_messages::transport::Guid;

    use super::*;
    use crate::test_decision::triggered;

    /// A grey image of 8x8 pixels as `sensor_msgs/msg/Image`, in CDR.
    fn image(grey: u8) -> Vec<u8> {
        let mut cdr = Vec::new();
        let text = |cdr: &mut Vec<u8>, text: &str| {
            cdr.resize(cdr.len().next_multiple_of(4), 0);
            cdr.extend((text.len() as u32 + 1).to_le_bytes());
            cdr.extend(text.bytes().chain([0]));
        };
        cdr.extend([0; 8]);
        text(&mut cdr, "cam");
        cdr.resize(cdr.len().next_multiple_of(4), 0);
        cdr.extend([8_u32, 8].iter().flat_map(|side| side.to_le_bytes()));
        text(&mut cdr, "mono8");
        cdr.push(0);
        cdr.resize(cdr.len().next_multiple_of(4), 0);
        cdr.extend([8_u32, 64].iter().flat_map(|n| n.to_le_bytes()));
        cdr.extend([grey; 64]);
        cdr
    }

    fn meta(at_ns: i64) -> SampleMeta {
        SampleMeta::new(at_ns, Guid::default(), at_ns as u64)
    }

    #[test]
    fn pictures_are_spread_over_all_triggers_and_replace_earlier_ones() {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join(FOLDER);
        fs::create_dir(&folder).unwrap();
        for name in ["trigger-000007.jpg", "000007.jpg", "mine.jpg"] {
            fs::write(folder.join(name), "old").unwrap();
        }
        let camera = RecordedCamera::new("/cam", "sensor_msgs/msg/Image");
        let mut pictures = TriggerPictures::new(&[], Some(camera.clone()));
        pictures.wake(&Decision { triggers: Vec::new(), ..triggered(0) });
        pictures.wake(&triggered(0));
        for n in 1..1000 {
            camera.see(&meta(10 * n), &image(n as u8));
            pictures.wake(&triggered(10 * n + 1));
        }
        let (written, omitted) = pictures.write(out.path()).unwrap();
        let (count, most) = (written.len(), Signals::PICTURES_MAX);
        assert!(count <= most && count > most / 3, "{count}");
        assert_eq!(written.len() as u64 + omitted, 1000);
        assert!(written.last().unwrap().at_ns > 9000, "the end of the drive has pictures");
        for TriggerPicture { at_ns, topic, image_ns, file } in written {
            assert_eq!((topic.as_str(), at_ns), ("/cam", image_ns + 1));
            assert!(fs::read(out.path().join(file)).unwrap().starts_with(&[0xff, 0xd8]));
        }
        assert_eq!(fs::read(folder.join("mine.jpg")).unwrap(), b"old");
        assert_eq!(fs::read(folder.join("000007.jpg")).unwrap(), b"old");
        assert!(!folder.join("trigger-000007.jpg").exists());
    }

    #[test]
    fn a_link_to_other_pictures_is_not_followed() {
        let (out, others) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        fs::write(others.path().join("trigger-000001.jpg"), "precious").unwrap();
        std::os::unix::fs::symlink(others.path(), out.path().join(FOLDER)).unwrap();
        assert!(TriggerPictures::new(&[], None).write(out.path()).is_err());
        assert!(others.path().join("trigger-000001.jpg").exists());
    }

    #[test]
    fn an_image_that_cannot_be_read_makes_no_picture() {
        let out = tempfile::tempdir().unwrap();
        let camera = RecordedCamera::new("/cam", "sensor_msgs/msg/Image");
        let mut pictures = TriggerPictures::new(&[], Some(camera.clone()));
        camera.see(&meta(1), b"no image");
        pictures.wake(&triggered(2));
        assert_eq!(pictures.write(out.path()).unwrap(), (Vec::new(), 1));
        assert!(!out.path().join(FOLDER).exists());
    }
}
