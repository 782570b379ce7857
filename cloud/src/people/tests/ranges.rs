use super::openapi::announce;
use super::*;

#[tokio::test]
async fn a_file_goes_on_at_a_position_and_other_ranges_get_all_of_it() {
    let (folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    cloud.store.invite_vehicle("console", "car-7").await.unwrap();
    announce(&cloud.store).await;
    cloud.store.execute("UPDATE clips SET state = 'stored'").await;
    let name = format!("{}.mcap", gleaner_trust::sha256(b"a@car-7"));
    let file = folder.path().join("data/clips").join(name);
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, "01234").unwrap();
    let path = (Method::GET, "/v1/clips/a@car-7/file");
    for (range, status, body) in [
        ("bytes=0-", 200, "01234"),
        ("bytes=3-", 206, "34"),
        ("bytes=4-", 206, "4"),
        ("bytes=1-2", 200, "01234"),
        ("bytes=-2", 200, "01234"),
        ("bytes=1-,3-", 200, "01234"),
        ("bytes=+1-", 206, "1234"),
        ("bytes=99999999999999999999-", 200, "01234"),
        ("lines=1-", 200, "01234"),
        ("", 200, "01234"),
        ("bytes=5-", 416, ""),
        ("bytes=18446744073709551615-", 416, ""),
    ] {
        let answer = send(&cloud, path.clone(), Some(&token), &[("range", range)], "").await;
        assert_eq!(answer.status, status, "{range}");
        if status == 416 {
            assert_eq!(answer.headers[header::CONTENT_RANGE], "bytes */5");
            assert!(answer.json()["help"].as_str().unwrap().contains("Content-Range"), "{range}");
        } else {
            assert_eq!(String::from_utf8_lossy(&answer.body), body, "{range}");
        }
    }
}
